"""Messages to one legacy peer: fragments in priority order, a window of three, retransmitted until acknowledged.

The legacy receiver acknowledges every fragment at once; the legacy sender never retransmits. This sender retransmits a
fragment when its acknowledgment is overdue by the measured round trip, and probes an unresponsive peer with single
fragments.

The legacy receiver does not remember finished messages: it delivers a message again once all of its fragments came
again. So no message is sent as a single fragment: a short one is followed by an empty second fragment, which is
retransmitted only after the first one is acknowledged. A message then arrives twice only if both acknowledgments are
lost, or both late.

It discards the fragments of a message 10 s after the last one arrived, although it acknowledged them. A message that
was interrupted for almost as long is sent again from its start.
"""

from collections import OrderedDict
from dataclasses import dataclass

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.sender.pending import Outcome
from udp_mesh.core.sender.probing import PROBE_INTERVAL_S
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Address
from udp_mesh.wire.legacy import (
    LAST_SEQUENCE as LAST_SEQUENCE,
)
from udp_mesh.wire.legacy import (
    LegacyPayload,
    PriorityMeshData,
    encode_legacy,
    encode_mesh_data,
    fragment_legacy,
    is_ros_type,
)
from udp_mesh.wire.limits import MAX_LEGACY_FRAGMENT_BYTES, PRIORITY_LEVELS

LEGACY_WINDOW = 3
"""Fragments in flight to a legacy peer: the value it uses itself; with more, its radios were seen to interfere."""

TRIES_BEFORE_UNRESPONSIVE = 3
"""Attempts at one fragment, with nothing acknowledged meanwhile, after which only single probes are sent."""

MAX_DOUBLINGS, MAX_DOUBLINGS_WHILE_ACKED = 3, 1
"""How often the timeout of a fragment doubles. If the peer acknowledges others, some fragments are simply lost, and
waiting longer would cost an urgent one most of a second. It still doubles once: the path may have become slower."""

MIN_TIMEOUT_S = 0.025
"""Earliest retransmission: legacy programs answer when their interpreter is scheduled."""

MAX_TIMEOUT_S = 0.2
"""Upper bound of that minimum, which grows if both transmissions of a fragment are acknowledged: the second was
needless."""

MAX_PAUSE_S = 8.0
"""A message of which no fragment arrived for longer than this is restarted: after 10 s the receiver has none of it."""

RESENT_REMEMBERED = 64
"""Fragments acknowledged after a retransmission that may be acknowledged again."""

TIMEOUT_DECAY = 0.995
"""Decay toward `MIN_TIMEOUT_S` per acknowledgment of a first attempt: it takes some hundred of them."""


@dataclass(slots=True)
class _SentFragment:
    """One fragment in flight."""

    message: OutgoingMessage
    position: int
    sent_at: float
    tries: int
    acks: int
    """Acknowledgments of any fragment received when it was last sent."""
    unanswered: int
    """Its attempts since the last of them."""
    attempted_at: float
    """When it was last sent; `sent_at` may be set to let it be sent again at once."""


def can_publish(type_name: str) -> bool:
    """Whether a legacy robot can publish a message of this type: `pkg/Type`, or none given. Anything else (a bridge's
    own messages, ROS 2, Zenoh) ends its reader's callback with a traceback."""
    name = type_name.partition(" ")[0]
    return not name or is_ros_type(name)


class LegacySender:
    """The sending half for one legacy peer; queues and outcomes are those of its `Sender`."""

    __slots__ = (
        "_acks",
        "_arrived_at",
        "_fragments",
        "_in_flight",
        "_min_timeout_s",
        "_own_name",
        "_resent",
        "_sequence",
        "_sequences",
        "_stamp",
        "sender",
        "unresponsive",
    )

    def __init__(self, sender: Sender, own_name: str, first_sequence: int) -> None:
        """`first_sequence` is random per run: the peer may still hold fragments of our previous run (its defect 8)."""
        self.sender = sender
        self.unresponsive = False
        self._acks = 0
        self._min_timeout_s = MIN_TIMEOUT_S
        self._resent: OrderedDict[tuple[int, int], None] = OrderedDict()
        self._own_name = own_name
        self._sequence = first_sequence % LAST_SEQUENCE
        self._stamp = 0
        self._in_flight: dict[tuple[int, int], _SentFragment] = {}
        self._sequences: dict[int, OutgoingMessage] = {}
        self._fragments: dict[OutgoingMessage, tuple[int, list[bytes]]] = {}
        self._arrived_at: dict[OutgoingMessage, float] = {}
        """When the newest fragment that is acknowledged was sent, at the latest attempt: it arrived soon after."""

    def send(self, link: str, address: Address, now: float, out: list[Datagram]) -> None:
        """Send what may be sent now: overdue fragments first, then new ones, most urgent first."""
        if not self.unresponsive:
            for message in [message for message in self._arrived_at if self._is_interrupted(message, now)]:
                self.sender.resend_from_start(message)
        self._forget_ended()
        self._resend(link, address, now, out)
        sender = self.sender
        scheduler = sender.scheduler
        for priority in range(PRIORITY_LEVELS):
            urgent = priority <= sender.rates.urgent_priority
            window = LEGACY_WINDOW + (sender.rates.urgent_excess_packets if urgent else 0)
            while scheduler.waiting >> priority & 1 and not self.unresponsive and self._window_used() < window:
                run = scheduler.peek(priority)
                if run is None:
                    break
                message = run.message
                if not message.started:
                    if not self._begin(message, now):
                        sender.finish(message, ExpiryReason.REFUSED)
                        continue
                    run = scheduler.peek(priority)
                    assert run is not None
                # The empty fragment goes with its first one: it takes no place in the window.
                count = run.length if self._has_empty_tail(message) else 1
                scheduler.consume(run, count)
                for position in range(run.position, run.position + count):
                    self._send(message, position, 1, link, address, now, out)
                if not message.reliable and message.next_position == message.fragments and message.missing == 0:
                    sender.finish(message, Outcome.SENT)

    def acknowledge(self, sequence: int, position: int, now: float) -> None:
        """Process an acknowledgment; unknown ones are ignored."""
        sent = self._in_flight.pop((sequence, position), None)
        self.unresponsive = False
        self._acks += 1
        if sent is None:
            if (sequence, position) in self._resent:
                del self._resent[sequence, position]
                self._min_timeout_s = min(MAX_TIMEOUT_S, 2 * self._min_timeout_s)
            return
        if sent.tries > 1:
            self._resent[sequence, position] = None
            if len(self._resent) > RESENT_REMEMBERED:
                self._resent.popitem(last=False)
        else:
            self._min_timeout_s = max(MIN_TIMEOUT_S, TIMEOUT_DECAY * self._min_timeout_s)
            # Karn's algorithm: after a retransmission the acknowledged attempt is unknown.
            self.sender.rtt.sample(max(1e-5, now - sent.sent_at), now)
        message = sent.message
        if self._is_interrupted(message, now):
            self.sender.resend_from_start(message)
        elif not message.ended and message.mark_arrived(position):
            self._arrived_at[message] = max(sent.attempted_at, self._arrived_at.get(message, sent.attempted_at))
            self.sender.delivered_bytes += len(self._fragments[message][1][position])
            if not message.missing:
                self.sender.finish(message, Outcome.DELIVERED)
        self.sender.delivered_packets += 1
        self.sender.delivered_at = now

    def _is_interrupted(self, message: OutgoingMessage, now: float) -> bool:
        """Whether the receiver may have discarded the fragments that arrived."""
        return not message.ended and now - self._arrived_at.get(message, now) > MAX_PAUSE_S

    def on_activity(self) -> None:
        """Something came from an unresponsive peer: everything in flight is due at once."""
        if self.unresponsive:
            self.unresponsive = False
            for sent in self._in_flight.values():
                sent.sent_at = float("-inf")
                sent.tries = 1
                sent.unanswered = 0

    def timer(self) -> float | None:
        """When the next fragment is overdue."""
        overdue_at = (
            sent.sent_at + self._timeout_s(sent) for sent in self._in_flight.values() if not self._follows_first(sent)
        )
        return min(overdue_at, default=None)

    def _window_used(self) -> int:
        """Fragments in flight that carry data."""
        return sum(bool(self._fragments[sent.message][1][sent.position]) for sent in self._in_flight.values())

    def _has_empty_tail(self, message: OutgoingMessage) -> bool:
        """Whether the message is one fragment of data and an empty one."""
        fragments = self._fragments[message][1]
        return len(fragments) == 2 and not fragments[1]

    def _follows_first(self, sent: _SentFragment) -> bool:
        """Whether this empty fragment waits for the acknowledgment of the first one before it is retransmitted."""
        if not sent.position or not self._has_empty_tail(sent.message):
            return False
        return (self._fragments[sent.message][0], 0) in self._in_flight

    def _timeout_s(self, sent: _SentFragment) -> float:
        timeout = max(self._min_timeout_s, self.sender.rtt.pto_s(0.0))
        doublings = min(sent.tries - 1, MAX_DOUBLINGS_WHILE_ACKED)
        if sent.acks == self._acks:
            doublings = max(doublings, min(sent.unanswered - 1, MAX_DOUBLINGS))
        return min(PROBE_INTERVAL_S, timeout * (1 << doublings))

    def _resend(self, link: str, address: Address, now: float, out: list[Datagram]) -> None:
        due = [
            sent
            for sent in self._in_flight.values()
            if now >= sent.sent_at + self._timeout_s(sent) and not self._follows_first(sent)
        ]
        due.sort(key=lambda sent: sent.message.priority)
        for sent in due:
            if sent.unanswered >= TRIES_BEFORE_UNRESPONSIVE and sent.acks == self._acks:
                self.unresponsive = True
            self._send(sent.message, sent.position, sent.tries + 1, link, address, now, out)
            self.sender.retransmitted += 1
            if self.unresponsive:
                # One probe; the others wait until it is acknowledged.
                for other in self._in_flight.values():
                    if other is not sent:
                        other.sent_at = now
                break

    def _begin(self, message: OutgoingMessage, now: float) -> bool:
        """Serialize, fragment and number the message. False if the format cannot carry it (it then ends as refused)."""
        accepted = message.accepted
        if not can_publish(accepted.channel.type_name):
            return False
        self._stamp = (self._stamp + 1) & 0xFFFFFFFF
        channel = accepted.channel
        seconds = int(now)
        data = PriorityMeshData(
            self._own_name,
            # Our bridges append an md5sum to the type name; a legacy robot would take it for part of the type.
            channel.type_name.partition(" ")[0],
            message.priority,
            channel.name,
            accepted.payload,
            self._stamp,
            seconds & 0xFFFFFFFF,
            int((now - seconds) * 1e9),
        )
        body = encode_mesh_data(data)
        fragments = fragment_legacy(body)
        if len(fragments) == 1:
            fragments.append(b"")
        sequence = self._next_sequence()
        message.begin(sequence, MAX_LEGACY_FRAGMENT_BYTES, MAX_LEGACY_FRAGMENT_BYTES)
        message.fragments = message.missing = len(fragments)
        message.arrived = bytearray(len(fragments))
        self._sequences[sequence] = message
        self._fragments[message] = (sequence, fragments)
        return True

    def _next_sequence(self) -> int:
        """The next number not in use: a new message never meets an old one's fragments."""
        while True:
            self._sequence = self._sequence % LAST_SEQUENCE + 1
            if self._sequence not in self._sequences:
                return self._sequence

    def _send(
        self,
        message: OutgoingMessage,
        position: int,
        tries: int,
        link: str,
        address: Address,
        now: float,
        out: list[Datagram],
    ) -> None:
        sequence, fragments = self._fragments[message]
        before = self._in_flight.get((sequence, position))
        unanswered = before.unanswered + 1 if before is not None and before.acks == self._acks else 1
        self._in_flight[(sequence, position)] = _SentFragment(
            message, position, now, tries, self._acks, unanswered, now
        )
        payload = LegacyPayload(sequence, position, len(fragments), fragments[position], wants_ack=True)
        data = encode_legacy(payload)
        urgent = message.priority <= self.sender.rates.urgent_priority
        out.append(Datagram(link, address, data, urgent))
        self.sender.sent_packets += 1
        self.sender.sent_bytes += len(data) + IP_UDP_BYTES

    def _forget_ended(self) -> None:
        for message in [message for message in self._fragments if message.ended]:
            sequence, fragments = self._fragments.pop(message)
            self._arrived_at.pop(message, None)
            del self._sequences[sequence]
            for position in range(len(fragments)):
                self._in_flight.pop((sequence, position), None)
