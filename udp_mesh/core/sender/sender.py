"""The messages for one peer: accepted -> scheduled -> in flight -> delivered, expired or peer lost.

1. `accept` queues a message. `packetizer` takes fragments from the scheduler when datagrams are built and records them.
2. `acknowledge` records arrivals, measures round trip, rate and loss, and requeues lost fragments by priority.
3. `handle_timer` declares packets lost when acknowledgements stay away. After some more time the peer is
   *unresponsive*: everything in flight is requeued and only probes are sent, while the window and rate model stay
   unchanged.
4. `on_activity` resumes sending; `restart` starts over with a peer that lost its state.

`pending` holds the messages without an outcome.
"""

from collections.abc import Iterable

from udp_mesh.core.congestion.controller import CongestionController, FixedWindow
from udp_mesh.core.congestion.delay_based import DelayBasedController
from udp_mesh.core.congestion.pacer import Pacer
from udp_mesh.core.congestion.rtt import INITIAL_PTO_S
from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.sender.loss_estimate import LossEstimate
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.packing import Packing
from udp_mesh.core.sender.pending import PendingMessages
from udp_mesh.core.sender.pmtu import PathMtu
from udp_mesh.core.sender.probing import PROBE_INTERVAL_S, Probing
from udp_mesh.core.sender.redundancy import OVERDUE_ROUND_TRIPS, RedundantCopies
from udp_mesh.core.sender.round_trips import RoundTrips
from udp_mesh.core.sender.scheduler import Scheduler
from udp_mesh.core.sender.send_memory import SendMemory
from udp_mesh.core.sender.send_state import TRANSITIONS, SendEvent, SendState
from udp_mesh.core.sender.sent_packets import Packet, SendSnapshot, SentPackets
from udp_mesh.core.settings import Rates, Settings
from udp_mesh.wire.frames import Ack

UNRESPONSIVE_AFTER_PTOS = 3
UNRESPONSIVE_AFTER_S = 0.25
"""Without an acknowledgement for both of these the peer is unresponsive. Until then timed-out packets are replaced at
the pace of the window: a burst of losses costs little more than its own length."""

MIN_ACK_GAP_S = 0.02
"""Minimum time without acknowledgements before packets time out: twice what the peer holds them back."""

MAX_ACK_WAIT_S = 1.0
"""How long an acknowledgement is awaited after a message's deadline at most."""

EXPIRE_INTERVAL_S = 0.005
"""Between two checks for timed-out packets."""

STALE_AFTER_S = 1.0
"""After an outage, messages that are not urgent and have waited longer than this share their level with new ones."""


class Sender(PendingMessages):
    """The sending half of a session. Times in seconds. `memory` counts what waits for all peers together,
    for this one under the name `peer`."""

    def __init__(self, settings: Settings, memory: SendMemory | None = None, peer: str = "") -> None:
        super().__init__(memory or SendMemory(settings.limits.queue_bytes), peer)
        self.round_trips = RoundTrips()
        self.rtt = self.round_trips.path
        self.congestion: CongestionController = DelayBasedController(self.rtt)
        self.pacer = Pacer(settings.rates.pace_quantum_s)
        self.in_flight = SentPackets()
        self.scheduler = Scheduler()
        self.rates: Rates = settings.rates
        self.announced: set[int] = set()
        """Numbers of the topics that the peer knows by name."""
        self.next_wire_id = 0
        self.epoch = 0
        """Counts the peer's boots: wire ids of an earlier one mean nothing to the current one."""
        self.copies = RedundantCopies()
        self.served = 0
        """Mask of the levels that sent something in this round."""
        self.wake_at = float("inf")
        """When pacing permits the next quantum."""
        self.state = SendState.ACTIVE
        self.timed_out: list[Packet] = []
        """Packets that timed out and are neither acknowledged nor retransmitted."""
        self.expired_at = float("-inf")
        self.urgent_sent_at = float("-inf")
        self.probing = Probing()
        self.pmtu = PathMtu()
        self.last_progress = 0.0
        self.non_urgent_progress = 0.0
        """When the last packet that was not urgent was acknowledged."""
        self.app_limited = True
        """The application, not window or pacing, limits how much is sent."""
        self.since_ack_requested = 0
        """Packets sent since the last one that requested an immediate acknowledgement."""
        self.ack_requested_at = float("-inf")
        """When the end of the queue last requested one."""
        self.packing = Packing()
        self.loss = LossEstimate()
        self.delivered_packets = 0
        self.delivered_at = 0.0
        self.delivered_sent_at = 0.0
        self.delivered_bytes = 0
        self.retransmitted = 0
        self.sent_packets = 0
        self.sent_bytes = 0
        self.apply(settings)

    def apply(self, settings: Settings) -> None:
        """Apply new settings; nothing in flight is touched."""
        self.rates = settings.rates
        self.pacer = Pacer(settings.rates.pace_quantum_s)
        if isinstance(settings.window, int):
            self.congestion = FixedWindow(settings.window)
        elif not isinstance(self.congestion, DelayBasedController):
            self.congestion = DelayBasedController(self.rtt)

    # Accepting

    def accept(self, message: OutgoingMessage, now: float) -> None:
        """Accept a message and queue it on its level."""
        self.add(message)
        if not self.in_flight.outstanding and self.state is not SendState.UNRESPONSIVE:
            self.last_progress = now
        if self.state is SendState.UNRESPONSIVE and message.priority <= self.rates.urgent_priority:
            # A new urgent message is the best probe; what waited until now goes behind it.
            self.allow_probe(now)
        self.scheduler.push(message)

    # Acknowledgements

    def acknowledge(self, ack: Ack, now: float) -> None:
        """Process an acknowledgement from the peer."""
        in_flight = self.in_flight
        received = ack.received << 1 | 1
        # Sparse traffic has too few later packets to detect loss otherwise.
        timed_out = in_flight.confirm_timed_out(ack.largest, received) if ack.largest < in_flight.next_number else 0
        spurious = in_flight.spurious
        acknowledged, lost, newest = in_flight.acknowledge(ack.largest, received)
        if acknowledged:
            # Packets acknowledged late and all at once say nothing about the rate of the link.
            after_silence = self.state is not SendState.ACTIVE
            self.round_trips.on_acknowledged(self.last_progress, now)
            self.last_progress = now
            if not all(packet.snapshot.urgent for packet in acknowledged):
                self.non_urgent_progress = now
            if self.state is SendState.UNRESPONSIVE:
                self._on_responsive(now)
            self._transition(SendEvent.ACKNOWLEDGED)
            if self.pmtu.suspect:
                self.pmtu.on_acked(acknowledged, in_flight.spurious - spurious, now)
            self._record_arrivals(acknowledged)
            if self.timed_out:
                self._requeue_timed_out()
            rate: float | None = None
            largest = -1
            ahead = 0
            count = len(acknowledged)
            self.delivered_packets += count
            if newest is not None:
                snapshot = newest.snapshot
                if self.round_trips.sample(snapshot, ack.delay_us * 1e-6, now):
                    largest = ack.largest
                elapsed = max(now - snapshot.delivered_at, snapshot.sent_at - snapshot.delivered_sent_at)
                if elapsed > 0 and not after_silence:
                    rate = (self.delivered_packets - snapshot.delivered) / elapsed
                self.delivered_sent_at = snapshot.sent_at
                ahead = snapshot.packets_ahead_of(ack.largest)
            self.delivered_at = now
            app_limited = newest is None or newest.snapshot.app_limited
            outstanding = in_flight.outstanding
            if self.congestion.drain_overdue(now) and not in_flight.non_urgent_outstanding():
                # The few urgent packets sent during a drain do not form a queue.
                outstanding = 0
            self.congestion.on_ack(
                count,
                largest,
                in_flight.next_number,
                outstanding,
                rate,
                app_limited=app_limited,
                ahead=ahead,
                lost=len(lost),
                loss=self.loss.rate,
                now=now,
            )
        if lost:
            self.pmtu.on_lost(lost)
            self._requeue(lost)
        lost_packets = len(lost) + timed_out
        self.loss.add(lost_packets, len(acknowledged) + lost_packets, self.rates.twice_loss)

    def _record_arrivals(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            _, message, position, more = packet
            if not position:
                self.announced.add(message.accepted.channel.number)
            if not message.ended and not message.arrived[position]:
                message.arrived[position] = 1
                message.missing -= 1
                self.delivered_bytes += message.fragment_bytes if position else message.first_bytes
                if not message.missing:
                    self.on_arrived(message)
            elif message.version is not None:
                message.version.on_fragment_arrived(message, position)
            for message, position in more:
                if not position:
                    self.announced.add(message.accepted.channel.number)
                if not message.ended and message.mark_arrived(position):
                    self.delivered_bytes += len(message.body)
                    if not message.missing:
                        self.on_arrived(message)
                elif message.version is not None:
                    message.version.on_fragment_arrived(message, position)

    def _requeue(self, packets: Iterable[Packet]) -> None:
        """Requeue the lost fragments of reliable messages on their level."""
        for packet in packets:
            self._requeue_fragment(packet.message, packet.position)
            for message, position in packet.more:
                self._requeue_fragment(message, position)

    def _requeue_fragment(self, message: OutgoingMessage, position: int) -> None:
        if message.ended or not message.reliable or message.arrived[position]:
            return
        if message.superseded:
            self.finish(message, ExpiryReason.SUPERSEDED)
        elif not message.overdue:
            self.scheduler.push_retransmit(message, position)

    def schedule_copies(self, message: OutgoingMessage, position: int, now: float) -> None:
        """Schedule redundant copies of a small urgent fragment sent for the first time."""
        self.copies.schedule(
            message,
            position,
            now,
            gap_s=self.rates.twice_gap_s,
            twice=self.loss.send_twice,
            loss=self.loss.rate,
            urgent_timeout_s=self.urgent_timeout_s(),
        )

    def urgent_timeout_s(self) -> float:
        """Time after which the acknowledgement of an urgent fragment is overdue."""
        smoothed_rtt = self.round_trips.urgent.smoothed_rtt or self.rtt.smoothed_rtt
        return INITIAL_PTO_S if smoothed_rtt is None else OVERDUE_ROUND_TRIPS * smoothed_rtt + self.rates.twice_gap_s

    # Unresponsive peer

    def timer(self) -> float | None:
        """When `handle_timer` is due for probes, deadlines or redundant copies. Calling it late is harmless."""
        at: float | None = None
        if self.state is SendState.UNRESPONSIVE:
            if self.pending or self.in_flight.outstanding:
                at = self.probing.next_at()
        elif self.in_flight.outstanding:
            at = self._expiry_at()
        elif self._is_timed_out_due():
            at = self.expired_at + EXPIRE_INTERVAL_S
        deadline = self.next_deadline()
        if deadline is not None and (at is None or deadline < at):
            at = deadline
        wake_at = min(self.wake_at, self.pmtu.comparisons.next_at, self.copies.next_at)
        if wake_at != float("inf") and (at is None or wake_at < at):
            at = wake_at
        return at

    def pto_s(self) -> float:
        """Probe timeout: time without progress after which the oldest packet counts as lost."""
        return self.rtt.pto_s(self.rates.ack_delay_s, PROBE_INTERVAL_S)

    def handle_timer(self, now: float) -> None:
        responsive = self.state is not SendState.UNRESPONSIVE
        self.expire(now, min(self.rtt.pto_s(self.rates.ack_delay_s), MAX_ACK_WAIT_S) if responsive else 0.0)
        if self.wake_at <= now:
            self.wake_at = float("inf")
        if self.state is SendState.UNRESPONSIVE:
            awaited = self.pending or self.in_flight.outstanding
            if awaited and now >= self.probing.next_at():
                self.allow_probe(now)
        elif self.in_flight.outstanding:
            timeout = self.pto_s()
            if now >= self.last_progress + max(UNRESPONSIVE_AFTER_PTOS * timeout, UNRESPONSIVE_AFTER_S):
                self.become_unresponsive(now)
            elif now >= self._expiry_at():
                self.expired_at = now
                self._declare_timed_out(now - timeout)
        elif self._is_timed_out_due():
            self._requeue_timed_out()

    def _expiry_at(self) -> float:
        """When to check for packets whose acknowledgement is overdue."""
        oldest = self.in_flight.oldest()
        if oldest is None:
            return float("inf")
        timeout = self.pto_s()
        # Urgent packets overtake others in radios, so their acknowledgement is no progress for a packet that is not
        # urgent.
        progress = self.last_progress if oldest.urgent else self.non_urgent_progress
        quiet = progress + max(MIN_ACK_GAP_S, timeout / 2)
        return max(quiet, oldest.sent_at + timeout, self.expired_at + EXPIRE_INTERVAL_S)

    def _declare_timed_out(self, sent_before: float) -> None:
        """Declare packets sent before then lost, so that others may be sent.

        The next acknowledgement shows whether they or only their acknowledgements were lost. Until then urgent
        fragments are retransmitted; others only if nothing else waits.
        """
        self._transition(SendEvent.TIMED_OUT)
        for packet in self.in_flight.declare_lost_before(sent_before):
            if packet.message.priority <= self.rates.urgent_priority:
                self._requeue((packet,))
            else:
                self.timed_out.append(packet)
            self.pmtu.on_lost((packet,))
        if self.timed_out and not self.scheduler.waiting:
            self._requeue_timed_out()

    def _is_timed_out_due(self) -> bool:
        """Whether timed-out fragments are all that is left to send, with nothing in flight whose acknowledgement or age
        would return them. When they timed out something waited, but needed no sending: it was acknowledged late, or a
        batch had ended with the last of it and its level was still marked."""
        return bool(self.timed_out) and not self.in_flight.outstanding and not self.scheduler.waiting

    def _requeue_timed_out(self) -> None:
        timed_out, self.timed_out = self.timed_out, []
        self._requeue(timed_out)

    def become_unresponsive(self, now: float) -> None:
        """Requeue everything in flight and send only probes from now on."""
        self._transition(SendEvent.NO_PROGRESS)
        self.probing.begin(now)
        self.allow_probe(now)

    def _transition(self, event: SendEvent) -> None:
        self.state = TRANSITIONS[self.state, event]

    def allow_probe(self, now: float) -> None:
        """Let the most urgent fragment probe an unresponsive peer, unless another probe was just allowed."""
        if self.probing.allow_probe(now):
            self._demote_in_flight()

    def consume_small_probe(self, now: float) -> bool:
        """Whether a ping is sent as the probe just allowed: nothing waits, or full fragments may be too large for the
        path (then with one probe in a few, and later in its place)."""
        if self.state is not SendState.UNRESPONSIVE or not self.probing.credit:
            return False
        if self.scheduler.waiting:
            if not self.pmtu.next_probe_is_small():
                return False
            if self.probing.is_slow(now):
                self.probing.credit = 0
        self.pmtu.on_small_probe_sent()
        return True

    def _demote_in_flight(self) -> None:
        """Requeue everything in flight; urgent messages go behind new ones."""
        self._requeue_timed_out()
        given_up = self.in_flight.abandon_all()
        self.pmtu.on_lost(given_up)
        self._requeue(given_up)
        self.scheduler.demote_stale(self.rates.urgent_priority)

    def on_activity(self, now: float) -> None:
        """Record that an authentic datagram arrived. To an unresponsive peer a first burst is sent; the rest waits for
        an acknowledgement."""
        if self.state is SendState.UNRESPONSIVE and self.probing.allow_burst(now, int(self.congestion.cwnd)):
            self._demote_in_flight()

    def _on_responsive(self, now: float) -> None:
        self.probing.end()
        self.scheduler.demote_stale(self.rates.urgent_priority)
        self.scheduler.alternate_stale(self.rates.urgent_priority + 1, now - STALE_AFTER_S)

    def reprioritize(self) -> None:
        """Move waiting messages to their topics' new levels."""
        if self.levels.reprioritize(self.pending):
            self.scheduler.rebuild(list(self.pending), keep_fragments=True)

    # Restart

    def restart(self, now: float) -> None:
        """Restart every pending message under a new number: the peer restarted, or its state is unknown."""
        self.in_flight.restart(0)
        self.timed_out.clear()
        self.announced.clear()
        self.copies.clear()
        self.cancelled.clear()
        self.unconfirmed.clear()
        self.next_wire_id = 0
        self.epoch += 1
        self._transition(SendEvent.RESTARTED)
        self.probing.credit = 0
        self.last_progress = now
        messages = list(self.pending)
        self.pending.clear()
        for message in messages:
            self.restart_message(message)
        self.scheduler.rebuild(list(self.pending), keep_fragments=False)

    def request_confirmations(self, now: float) -> bool:
        """Send fragments of unconfirmed messages again if their confirmations are overdue. False if none is."""
        due = self.confirmations_due(now)
        for message in due:
            if message.arrived[0]:
                message.arrived[0] = 0
                message.missing += 1
                self.scheduler.push_retransmit(message, 0)
        return bool(due)

    def resend_from_start(self, message: OutgoingMessage) -> None:
        """Restart a message whose fragments the peer discarded."""
        self.announced.discard(message.accepted.channel.number)
        self.scheduler.push(self.restart_message(message))

    def resume(self, message: OutgoingMessage, now: float) -> None:
        """Resume a withdrawn message where it stopped."""
        copy = message.resumed()
        self.accept(copy, now)
        if not copy.missing:
            self.on_arrived(copy)
        for position in range(copy.next_position):
            if not copy.arrived[position]:
                self.scheduler.push_retransmit(copy, position)

    def snapshot(self, now: float, *, urgent: bool = False) -> SendSnapshot:
        """The state in which one burst of packets is sent."""
        if not self.in_flight.outstanding and self.state is SendState.ACTIVE:
            self.delivered_at = self.delivered_sent_at = self.last_progress = now
        return SendSnapshot(
            now,
            self.delivered_packets,
            self.delivered_at,
            self.delivered_sent_at,
            self.app_limited,
            urgent,
            self.in_flight.next_number,
            self.in_flight.outstanding,
        )
