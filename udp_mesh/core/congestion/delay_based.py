"""How many packets may be on their way to one peer: delay decides, loss does not (radio loss is not congestion).

1. Startup doubles the window once per round trip until the round trip has grown by `STARTUP_QUEUE_S`.
2. Then, once per round trip: w <- w/2 + (w * least / standing + a) / 2, where a is `QUEUE_S` worth of packets (less on
   a short path, more where packets are lost): the window settles where the sender keeps that much queue at the
   bottleneck, and no more.
3. w never exceeds by much what the measured delivery rate needs, plus a, and growth that delivers nothing more ends: a
   queue too short to be seen as delay is not overrun.
4. A *drain* lets the queue run empty for one round trip, so that the least round trip is seen again: after
   `DRAIN_INTERVAL_S` without having seen it, and as soon as the round trip looks longer than our own queue explains. If
   it stays long while the queue is empty, the route has changed: the window moves at once to the new round trip times
   the delivery rate, by no more than startup would; on a route so long that this rate is none of its own it starts up
   again.
5. The least round trip is *proved* where it was seen with next to nothing of ours on its way. Once it differs from
   that (the path changed, or no drain has seen the empty path for long) the next drain goes down to
   `MIN_CWND` - 1 packets: a queue that stands for good would otherwise be taken for the path, and what it loses
   for the loss of a radio.

The idea of step 2 is that of FAST TCP (Jin, Wei, Low 2004), that of steps 3 and 4 of BBR's bandwidth model (Cardwell
and others 2016).
"""

from collections import deque
from enum import Enum

from udp_mesh.core.congestion.rtt import MIN_WINDOWED_RTT_S, RttEstimator

QUEUE_S = 0.003
"""Queue the sender keeps at the bottleneck: covers batched acknowledgements and pacing; adds this much to urgent
latency."""

MIN_QUEUE_S = 0.002
QUEUE_PER_ROUND_TRIP = 0.3
"""Acknowledgements come every few packets of a small window: on a short path less of a queue covers them."""

LOSS_QUEUE_S = 0.002
FULL_LOSS_QUEUE_AT = 0.05
"""Losses leave holes in the queue: so much more of it keeps the link busy, up to what urgent messages can bear."""

STARTUP_QUEUE_S = 0.006
"""Growth of the round trip that ends the startup: more than the scatter of a radio, less than an urgent message's
slack."""

MIN_QUEUE_PACKETS = 2.0
"""The same at low rates: fewer packets leave the link idle between acknowledgements."""

MIN_SHARED_QUEUE_PACKETS = 1.0
"""The same where others send on the channel too: they keep it busy meanwhile."""

UNSHARED_FROM_LOSS = 0.2
"""The more is lost the more often all wait at once, and the longer urgent messages may take: from this loss on the
queue is that of a single sender."""

MIN_CWND = 4.0
"""Packets: below, a lost packet has too few successors to be noticed without a timeout."""

MAX_CWND = 8192.0
"""Packets: 92 Mbit at 1400 B, more than any link these robots have; bounds the state kept per packet."""

PACE_GAIN = 1.25
"""The window, not the pacing, limits what is on its way: pacing only spreads it."""

CAPACITY_GAIN = 1.05
"""Pacing above the measured rate by this much notices when the link becomes faster, without building a queue."""

LOSS_GAIN = 0.3
"""And by this much of the loss: its estimate scatters, and too slow a pace costs throughput."""

MAX_LOSS = 0.35
"""The measured rate is that of deliveries; what is lost comes on top, up to this share of what is sent."""

INITIAL_CWND = 10.0
"""Packets before anything is known (RFC 6928)."""

MIN_UPDATE_S = MIN_WINDOWED_RTT_S
"""On links faster than this round trip the law runs at this pace: until then the standing round trip still tells of the
window before."""

MIN_STARTUP_UPDATE_S = 0.004
"""The same while starting, when only growth counts."""

RATE_WINDOW_S = 2.0
"""How long a measured delivery rate is believed."""

DRAIN_INTERVAL_S = 2.0
DRAIN_ROUND_TRIPS = 15.0
"""Between two drains, at least: each costs about a quarter of a round trip of throughput."""

UNVERIFIED_DRAIN_ROUND_TRIPS = 4.0
"""The same while the least round trip is not proved: what is built on it is wrong meanwhile."""

DRAIN_FRACTION = 0.95
DRAIN_PACKETS = 3
"""Part of the pipe filled while draining, less these packets: on a short path a burst of them is the queue."""

GROWTH = 1.25
"""Growth per round trip while the window is used up and yet no queue is seen: the link has become faster."""

GROWTH_AFTER_ROUNDS = 3
"""Round trips without a queue before growth: two happen by themselves around the law's balance."""

FULL_GROWTH = 1.1
FULL_ROUNDS = 3
"""A link that did not deliver a tenth more after so many rounds of growth is full, whatever its delay says."""

GROWTH_PAUSE_S = 2.0
"""How long after that growth is not tried again."""

RATE_BOUND = 1.2
STARTUP_RATE_BOUND = 2.5
"""The window never exceeds this many times what the measured rate needs; growing it must run ahead of the
measurement."""

ACK_BATCH_S = 0.008
"""About how long batched acknowledgements hold packets in the window beyond the round trip."""

SUSPECT_QUEUE_S = 0.015
"""Queueing of this much is more than our own window explains."""

SUSPECT_DRAIN_INTERVAL_S = 0.3
MAX_SUSPECT_DRAIN_INTERVAL_S = 4.0
"""Between two drains on suspicion, doubled each time one finds nothing."""


class Phase(Enum):
    STARTUP = 1
    CRUISE = 2
    DRAIN = 3
    """Waiting until little enough is in flight."""
    HOLD = 4
    """The queue is empty: waiting for the round trip of a packet sent now."""


class DelayBasedController:
    """The law of the module's docstring."""

    __slots__ = (
        "_cwnd_before_drain",
        "_drain_on_suspicion",
        "_drained_at",
        "_empty_rounds",
        "_full_capacity",
        "_full_drain",
        "_full_rounds",
        "_grow_after",
        "_growing",
        "_hold_from_number",
        "_hold_min_rtt",
        "_last_rtts",
        "_loss",
        "_rates",
        "_round_ends_at",
        "_rtt",
        "_suspect_interval_s",
        "_suspect_rounds",
        "_uncontended_acks",
        "_updated_at",
        "_verified_min_rtt",
        "_windowed_rtt_before_drain",
        "cwnd",
        "phase",
        "queue_share",
    )

    def __init__(self, rtt: RttEstimator) -> None:
        self._rtt = rtt
        self.queue_share = 1.0
        self.cwnd = INITIAL_CWND
        self.phase = Phase.STARTUP
        self._last_rtts: deque[float] = deque(maxlen=4)
        self._rates: deque[tuple[float, float]] = deque()
        self._uncontended_acks = 0
        self._verified_min_rtt = 0.0
        self._full_drain = False
        self._round_ends_at = 0
        self._updated_at = 0.0
        self._drained_at = 0.0
        self._empty_rounds = 0
        self._full_capacity = 0.0
        self._full_rounds = 0
        self._grow_after = 0.0
        self._growing = False
        self._loss = 0.0
        self._cwnd_before_drain = INITIAL_CWND
        self._windowed_rtt_before_drain = 0.0
        self._hold_from_number = 0
        self._hold_min_rtt = float("inf")
        self._drain_on_suspicion = False
        self._suspect_rounds = 0
        self._suspect_interval_s = SUSPECT_DRAIN_INTERVAL_S

    def capacity_packets_per_s(self) -> float | None:
        return self._rates[0][1] if self._rates else None

    def assume_delivery(self) -> bool:
        # A queue that our window does not explain is work enough for the link; and a drain wants it empty.
        return bool(self._rates) and self.phase in (Phase.STARTUP, Phase.CRUISE) and not self._unexplained_queue()

    def drain_overdue(self, now: float) -> bool:
        return self.phase in (Phase.DRAIN, Phase.HOLD) and now - self._updated_at > self._windowed_rtt_before_drain

    def pacing_packets_per_s(self) -> float | None:
        smoothed_rtt = self._rtt.smoothed_rtt
        if smoothed_rtt is None:
            return None
        if self.phase is Phase.STARTUP:
            return 2.0 * self.cwnd / smoothed_rtt
        rate = PACE_GAIN * self.cwnd / smoothed_rtt
        capacity = self.capacity_packets_per_s()
        return (
            rate
            if capacity is None or self._growing
            else min(rate, max(self._pacing_rate(capacity), MIN_CWND / smoothed_rtt))
        )

    def _pacing_rate(self, capacity: float) -> float:
        loss = min(self._loss, MAX_LOSS)
        return capacity * (CAPACITY_GAIN + LOSS_GAIN * loss) / (1 - loss)

    def on_ack(
        self,
        count: int,
        largest: int,
        next_number: int,
        in_flight: int,
        rate: float | None,
        *,
        app_limited: bool,
        ahead: int,
        loss: float,
        now: float,
    ) -> None:
        rtt = self._rtt
        if rtt.latest_rtt is None or rtt.min_rtt is None or rtt.windowed_rtt is None:
            return
        self._loss = loss
        if rate is not None:
            self._add_rate_sample(rate, app_limited=app_limited, now=now)
        self._last_rtts.append(rtt.latest_rtt)
        self._uncontended_acks = self._uncontended_acks + 1 if ahead < MIN_CWND - 1 else 0
        if app_limited and self._uncontended_acks >= 4 and min(self._last_rtts) > 1.15 * rtt.min_rtt + STARTUP_QUEUE_S:
            # None of the four found more of ours on its way than a drain leaves: the path itself is longer now. (An
            # application that pauses says nothing of that: a link that became slow still holds what it sent before.)
            rtt.reset_min_rtt(min(self._last_rtts), now)
            self._verified_min_rtt = rtt.min_rtt
        if self.phase is Phase.DRAIN:
            if in_flight <= self.cwnd or largest >= self._round_ends_at:
                # Everything sent before the drain has arrived, or so much that the rest is no queue.
                self.phase = Phase.HOLD
                self._hold_from_number = next_number
                self._hold_min_rtt = float("inf")
            elif now - self._updated_at > max(1.0, 2 * self._windowed_rtt_before_drain):
                self._end_drain(now)
            return
        if self.phase is Phase.HOLD:
            self._hold_min_rtt = min(self._hold_min_rtt, rtt.latest_rtt)
            if largest >= self._hold_from_number or rtt.latest_rtt <= rtt.min_rtt:
                self._end_drain(now)
                self._round_ends_at = next_number
            return
        if self.phase is Phase.STARTUP and not app_limited and min(self._last_rtts) - rtt.min_rtt > STARTUP_QUEUE_S:
            self.phase = Phase.CRUISE
            self._drained_at = now
            self.cwnd = max(MIN_CWND, self.cwnd * rtt.min_rtt / rtt.windowed_rtt)
        if largest < self._round_ends_at or now - self._updated_at < max(rtt.windowed_rtt, self._min_update_s()):
            return
        self._round_ends_at = next_number
        self._updated_at = now
        if rtt.latest_rtt <= rtt.min_rtt * 1.02 + 0.0005 and self._min_rtt_is_verified():
            # The empty path was seen just now: no drain is needed to see it.
            self._drained_at = now
        self._update(app_limited=app_limited, now=now)

    def _min_update_s(self) -> float:
        return MIN_STARTUP_UPDATE_S if self.phase is Phase.STARTUP else MIN_UPDATE_S

    def _unexplained_queue(self) -> bool:
        min_rtt, windowed_rtt = self._rtt.min_rtt, self._rtt.windowed_rtt
        return (
            min_rtt is not None
            and windowed_rtt is not None
            and windowed_rtt - min_rtt > SUSPECT_QUEUE_S + 0.25 * min_rtt
        )

    def _min_rtt_is_verified(self) -> bool:
        """Whether the least round trip is the one seen when next to nothing of ours was on its way; otherwise it may
        hold a queue that never ran empty."""
        min_rtt = self._rtt.min_rtt
        return (
            min_rtt is not None
            and abs(min_rtt - self._verified_min_rtt) <= 0.15 * self._verified_min_rtt + self._jitter_s()
        )

    def _jitter_s(self) -> float:
        """What the packets that a drain leaves on their way may take, and a radio's scatter."""
        return STARTUP_QUEUE_S / 3 + (MIN_CWND - 1) / (self.capacity_packets_per_s() or float("inf"))

    def _update(self, *, app_limited: bool, now: float) -> None:
        min_rtt, windowed_rtt = self._rtt.min_rtt, self._rtt.windowed_rtt
        assert min_rtt is not None
        assert windowed_rtt is not None
        if self.phase is Phase.STARTUP:
            # It begins with little on its way.
            self._verified_min_rtt = min_rtt
            if not app_limited:
                self._grow_startup(min_rtt, windowed_rtt, now)
            return
        since_drain = now - self._drained_at
        self._suspect_rounds = self._suspect_rounds + 1 if self._unexplained_queue() else 0
        if self._suspect_rounds >= 2 and since_drain > max(self._suspect_interval_s, 4 * windowed_rtt):
            self._begin_drain(now, suspicion=True)
            return
        every_round_trips = DRAIN_ROUND_TRIPS if self._min_rtt_is_verified() else UNVERIFIED_DRAIN_ROUND_TRIPS
        if since_drain > max(DRAIN_INTERVAL_S, every_round_trips * min_rtt):
            if (
                not self._suspect_rounds
                and self._min_rtt_is_verified()
                and (app_limited or windowed_rtt - min_rtt < QUEUE_S / 4)
            ):
                self._drained_at = now
            else:
                self._begin_drain(now, suspicion=self._suspect_rounds > 0)
                return
        empty = windowed_rtt - min_rtt < QUEUE_S / 4 and not app_limited and now >= self._grow_after
        self._empty_rounds = self._empty_rounds + 1 if empty else 0
        if self._empty_rounds >= GROWTH_AFTER_ROUNDS:
            capacity = self.capacity_packets_per_s() or 0.0
            if not self._growing or capacity > FULL_GROWTH * self._full_capacity:
                self._full_capacity, self._full_rounds = capacity, 0
            else:
                self._full_rounds += 1
            if self._full_rounds >= FULL_ROUNDS:
                self._growing = False
                self._empty_rounds = 0
                self._grow_after = now + GROWTH_PAUSE_S
                return
            self.cwnd = self._bounded(GROWTH * self.cwnd, min_rtt, windowed_rtt)
            self._growing = True
            return
        self._growing = False
        target = 0.5 * self.cwnd + 0.5 * (self.cwnd * min_rtt / windowed_rtt + self._queue_packets(windowed_rtt))
        if target < self.cwnd or not app_limited:
            self.cwnd = self._bounded(min(target, 2 * self.cwnd), min_rtt, windowed_rtt)

    def _restart(self, packets: float) -> None:
        """A route so much longer that what was measured on the one before does not tell how much it holds."""
        self.phase = Phase.STARTUP
        self.cwnd = min(MAX_CWND, max(INITIAL_CWND, packets))
        self._rates.clear()
        self._full_capacity, self._full_rounds = 0.0, 0

    def _grow_startup(self, min_rtt: float, windowed_rtt: float, now: float) -> None:
        """Double, unless the link has not become faster by it for some round trips (its queue is too short to see)."""
        capacity = self.capacity_packets_per_s() or 0.0
        if capacity > FULL_GROWTH * self._full_capacity:
            self._full_capacity = capacity
            self._full_rounds = 0
        else:
            self._full_rounds += 1
        if self._full_rounds >= FULL_ROUNDS:
            self.phase = Phase.CRUISE
            self._drained_at = now
            self._grow_after = now + GROWTH_PAUSE_S
            self.cwnd = self._bounded(self.cwnd, min_rtt, windowed_rtt)
        else:
            self.cwnd = max(self.cwnd, self._bounded(2 * self.cwnd, min_rtt, windowed_rtt))

    def _queue_packets(self, windowed_rtt: float) -> float:
        # Losses leave holes in the queue as well as in what arrives.
        lost_s = LOSS_QUEUE_S * min(1.0, self._loss / FULL_LOSS_QUEUE_AT)
        return self._shared_queue(self._target_queue_s() + lost_s, self.cwnd / windowed_rtt)

    def _target_queue_s(self) -> float:
        min_rtt = self._rtt.min_rtt
        assert min_rtt is not None
        return min(QUEUE_S, max(MIN_QUEUE_S, QUEUE_PER_ROUND_TRIP * min_rtt))

    def _shared_queue(self, queue_s: float, packets_per_s: float) -> float:
        """Packets of queue: `queue_s` at this rate and a least number, less of both where others send too."""
        if self.queue_share == 1.0:
            return max(MIN_QUEUE_PACKETS, queue_s * packets_per_s)
        relief = min(1.0, self._loss / UNSHARED_FROM_LOSS)
        share = self.queue_share + (1.0 - self.queue_share) * relief
        min_packets = MIN_SHARED_QUEUE_PACKETS * self.queue_share
        min_packets += (MIN_QUEUE_PACKETS - min_packets) * relief
        return max(min_packets, queue_s * share * packets_per_s)

    def _bounded(self, packets: float, min_rtt: float, windowed_rtt: float) -> float:
        capacity = self.capacity_packets_per_s()
        if capacity is not None:
            factor = RATE_BOUND if self.phase is Phase.CRUISE and not self._growing else STARTUP_RATE_BOUND
            # What waits for a batched acknowledgement is on its way too, and what is lost takes part in the window.
            pipe = capacity * (min_rtt + ACK_BATCH_S) / (1 - min(self._loss, MAX_LOSS))
            packets = min(packets, max(INITIAL_CWND, factor * pipe + self._queue_packets(windowed_rtt)))
        return min(MAX_CWND, max(MIN_CWND, packets))

    def _begin_drain(self, now: float, *, suspicion: bool) -> None:
        min_rtt, windowed_rtt = self._rtt.min_rtt, self._rtt.windowed_rtt
        assert min_rtt is not None
        assert windowed_rtt is not None
        self.phase = Phase.DRAIN
        self._drain_on_suspicion = suspicion
        self._cwnd_before_drain = self.cwnd
        self._windowed_rtt_before_drain = windowed_rtt
        self._hold_min_rtt = float("inf")
        self._updated_at = now
        self._full_drain = not self._min_rtt_is_verified()
        drained = 0.0 if self._full_drain else DRAIN_FRACTION * self.cwnd * min_rtt / windowed_rtt - DRAIN_PACKETS
        self.cwnd = max(MIN_CWND - 1, drained)

    def _end_drain(self, now: float) -> None:
        min_rtt = self._rtt.min_rtt
        assert min_rtt is not None
        hold_min_rtt = self._hold_min_rtt
        self.phase = Phase.CRUISE
        self._drained_at = self._updated_at = now
        # The queue is empty because of the drain: no reason to grow for the next round trips.
        self._grow_after = now + 3 * self._windowed_rtt_before_drain
        self._suspect_rounds = 0
        throughput = self._cwnd_before_drain / self._windowed_rtt_before_drain
        if self._full_drain and hold_min_rtt != float("inf"):
            self._verified_min_rtt = hold_min_rtt
        if (
            (self._drain_on_suspicion or self._full_drain)
            and hold_min_rtt > 1.15 * min_rtt + self._jitter_s()
            and hold_min_rtt != float("inf")
        ):
            self._rtt.reset_min_rtt(hold_min_rtt, now)
            self._suspect_interval_s = SUSPECT_DRAIN_INTERVAL_S
            if hold_min_rtt > (min_rtt + self._windowed_rtt_before_drain) / 2:
                # Still long although our queue is gone: the route, not the queue, is longer.
                throughput = max(throughput, self.capacity_packets_per_s() or 0.0)
                if hold_min_rtt > RATE_WINDOW_S / 3:
                    self._restart(2 * self._cwnd_before_drain)
                    return
        elif self._drain_on_suspicion:
            self._suspect_interval_s = min(2 * self._suspect_interval_s, MAX_SUSPECT_DRAIN_INTERVAL_S)
        else:
            self.cwnd = self._cwnd_before_drain
            return
        base = min(hold_min_rtt, self._windowed_rtt_before_drain) if hold_min_rtt != float("inf") else min_rtt
        queue = self._shared_queue(self._target_queue_s(), throughput)
        # The rate may have changed with the route: no further ahead of what was measured than when starting.
        max_cwnd = min(MAX_CWND, STARTUP_RATE_BOUND * max(INITIAL_CWND, self._cwnd_before_drain))
        self.cwnd = min(max_cwnd, max(MIN_CWND, throughput * base + queue))

    def _add_rate_sample(self, rate: float, *, app_limited: bool, now: float) -> None:
        """Windowed maximum; a rate the application limited says nothing unless it is larger."""
        rates = self._rates
        while rates and rates[0][0] < now - RATE_WINDOW_S and not (app_limited and len(rates) == 1):
            rates.popleft()
        if app_limited and (not rates or rate < rates[0][1]):
            return
        while rates and rates[-1][1] <= rate:
            rates.pop()
        rates.append((now, rate))
