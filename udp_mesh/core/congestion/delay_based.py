"""How many packets may be on their way to one peer: delay decides, loss does not (radio loss is not congestion).

1. Startup doubles the window once per round trip until the round trip has grown by `START_QUEUE_S`.
2. Then, once per round trip: w <- w/2 + (w * least / standing + a) / 2, where a is `QUEUE_S` worth of packets (less on
   a short path, more where packets are lost): the window settles where the sender keeps that much queue at the
   bottleneck, and no more.
3. w never exceeds by much what the measured delivery rate needs, plus a, and growth that delivers nothing more ends: a
   queue too short to be seen as delay is not overrun.
4. A *drain* lets the queue run empty for one round trip, so that the least round trip is seen again: after
   `DRAIN_EVERY_S` without having seen it, and as soon as the round trip looks longer than our own queue explains. If
   it stays long while the queue is empty, the route has changed: the window moves at once to the new round trip times
   the delivery rate, by no more than startup would; on a route so long that this rate is none of its own it starts up
   again.
5. The least round trip is *proved* where it was seen with next to nothing of ours on its way. Once it differs from
   that (the path changed, or no drain has seen the empty path for long) the next drain goes down to
   `LEAST_WINDOW` - 1 packets: a queue that stands for good would otherwise be taken for the path, and what it loses
   for the loss of a radio.

The idea of step 2 is that of FAST TCP (Jin, Wei, Low 2004), that of steps 3 and 4 of BBR's bandwidth model (Cardwell
and others 2016).
"""

from collections import deque
from enum import Enum

from udp_mesh.core.congestion.rtt import STANDING_WINDOW_S, RoundTrip

QUEUE_S = 0.003
"""Queue the sender keeps at the bottleneck: covers batched acknowledgements and pacing; adds this much to urgent
latency."""

SHORT_QUEUE_S = 0.002
QUEUE_PER_ROUND_TRIP = 0.3
"""Acknowledgements come every few packets of a small window: on a short path less of a queue covers them."""

LOSS_QUEUE_S = 0.002
LOSS_QUEUE_UP_TO = 0.05
"""Losses leave holes in the queue: so much more of it keeps the link busy, up to what urgent messages can bear."""

START_QUEUE_S = 0.006
"""Growth of the round trip that ends the startup: more than the scatter of a radio, less than an urgent message's
slack."""

LEAST_QUEUE_PACKETS = 2.0
"""The same at low rates: fewer packets leave the link idle between acknowledgements."""

LEAST_SHARED_QUEUE_PACKETS = 1.0
"""The same where others send on the channel too: they keep it busy meanwhile."""

SHARED_UP_TO_LOSS = 0.2
"""The more is lost the more often all wait at once, and the longer urgent messages may take: from this loss on the
queue is that of a single sender."""

LEAST_WINDOW = 4.0
"""Packets: below, a lost packet has too few successors to be noticed without a timeout."""

MOST_WINDOW = 8192.0
"""Packets: 92 Mbit at 1400 B, more than any link these robots have; bounds the state kept per packet."""

PACE_GAIN = 1.25
"""The window, not the pacing, limits what is on its way: pacing only spreads it."""

CAPACITY_GAIN = 1.05
"""Pacing above the measured rate by this much notices when the link becomes faster, without building a queue."""

LOSS_GAIN = 0.3
"""And by this much of the loss: its estimate scatters, and too slow a pace costs throughput."""

MOST_LOSS = 0.35
"""The measured rate is that of deliveries; what is lost comes on top, up to this share of what is sent."""

START_WINDOW = 10.0
"""Packets before anything is known (RFC 6928)."""

LEAST_UPDATE_S = STANDING_WINDOW_S
"""On links faster than this round trip the law runs at this pace: until then the standing round trip still tells of the
window before."""

LEAST_START_S = 0.004
"""The same while starting, when only growth counts."""

RATE_WINDOW_S = 2.0
"""How long a measured delivery rate is believed."""

DRAIN_EVERY_S = 2.0
DRAIN_EVERY_ROUND_TRIPS = 15.0
"""Between two drains, at least: each costs about a quarter of a round trip of throughput."""

PROVE_EVERY_ROUND_TRIPS = 4.0
"""The same while the least round trip is not proved: what is built on it is wrong meanwhile."""

DRAIN_TO = 0.95
DRAIN_PACKETS = 3
"""Part of the pipe filled while draining, less these packets: on a short path a burst of them is the queue."""

GROWTH = 1.25
"""Growth per round trip while the window is used up and yet no queue is seen: the link has become faster."""

GROW_AFTER_ROUNDS = 3
"""Round trips without a queue before growth: two happen by themselves around the law's balance."""

FULL_GROWTH = 1.1
FULL_ROUNDS = 3
"""A link that did not deliver a tenth more after so many rounds of growth is full, whatever its delay says."""

GROW_AGAIN_S = 2.0
"""How long after that growth is not tried again."""

RATE_BOUND = 1.2
START_RATE_BOUND = 2.5
"""The window never exceeds this many times what the measured rate needs; growing it must run ahead of the
measurement."""

ACK_BATCH_S = 0.008
"""About how long batched acknowledgements hold packets in the window beyond the round trip."""

SUSPECT_QUEUE_S = 0.015
"""Queueing of this much is more than our own window explains."""

SUSPECT_AGAIN_S = 0.3
MOST_SUSPECT_AGAIN_S = 4.0
"""Between two drains on suspicion, doubled each time one finds nothing."""


class Phase(Enum):
    STARTUP = 1
    CRUISE = 2
    DRAIN = 3
    """Waiting until little enough is in flight."""
    HOLD = 4
    """The queue is empty: waiting for the round trip of a packet sent now."""


class AdaptiveWindow:
    """The law of the module's docstring."""

    __slots__ = (
        "_alone",
        "_drained_at",
        "_empty_rounds",
        "_full_capacity",
        "_full_rounds",
        "_grow_from",
        "_growing",
        "_held_least",
        "_hold_from",
        "_latest_four",
        "_loss",
        "_proved",
        "_rates",
        "_round_ends",
        "_saved",
        "_suspect_every",
        "_suspected",
        "_suspicion",
        "_to_the_bottom",
        "_trip",
        "_updated_at",
        "_was_standing",
        "packets",
        "phase",
        "queue_share",
    )

    def __init__(self, trip: RoundTrip) -> None:
        self._trip = trip
        self.queue_share = 1.0
        self.packets = START_WINDOW
        self.phase = Phase.STARTUP
        self._latest_four: deque[float] = deque(maxlen=4)
        self._rates: deque[tuple[float, float]] = deque()
        self._alone = 0
        self._proved = 0.0
        self._to_the_bottom = False
        self._round_ends = 0
        self._updated_at = 0.0
        self._drained_at = 0.0
        self._empty_rounds = 0
        self._full_capacity = 0.0
        self._full_rounds = 0
        self._grow_from = 0.0
        self._growing = False
        self._loss = 0.0
        self._saved = START_WINDOW
        self._was_standing = 0.0
        self._hold_from = 0
        self._held_least = float("inf")
        self._suspicion = False
        self._suspected = 0
        self._suspect_every = SUSPECT_AGAIN_S

    def capacity(self) -> float | None:
        return self._rates[0][1] if self._rates else None

    def presumable(self) -> bool:
        # A queue that our window does not explain is work enough for the link; and a drain wants it empty.
        return bool(self._rates) and self.phase in (Phase.STARTUP, Phase.CRUISE) and not self._queue_is_suspect()

    def draining(self, now: float) -> bool:
        return self.phase in (Phase.DRAIN, Phase.HOLD) and now - self._updated_at > self._was_standing

    def packets_per_s(self) -> float | None:
        smoothed = self._trip.smoothed
        if smoothed is None:
            return None
        if self.phase is Phase.STARTUP:
            return 2.0 * self.packets / smoothed
        rate = PACE_GAIN * self.packets / smoothed
        capacity = self.capacity()
        return (
            rate
            if capacity is None or self._growing
            else min(rate, max(self._paced(capacity), LEAST_WINDOW / smoothed))
        )

    def _paced(self, capacity: float) -> float:
        loss = min(self._loss, MOST_LOSS)
        return capacity * (CAPACITY_GAIN + LOSS_GAIN * loss) / (1 - loss)

    def acknowledged(
        self,
        count: int,
        largest: int,
        next_number: int,
        in_flight: int,
        rate: float | None,
        *,
        limited: bool,
        ahead: int,
        loss: float,
        now: float,
    ) -> None:
        trip = self._trip
        if trip.latest is None or trip.least is None or trip.standing is None:
            return
        self._loss = loss
        if rate is not None:
            self._saw_rate(rate, limited=limited, now=now)
        self._latest_four.append(trip.latest)
        self._alone = self._alone + 1 if ahead < LEAST_WINDOW - 1 else 0
        if limited and self._alone >= 4 and min(self._latest_four) > 1.15 * trip.least + START_QUEUE_S:
            # None of the four found more of ours on its way than a drain leaves: the path itself is longer now. (An
            # application that pauses says nothing of that: a link that became slow still holds what it sent before.)
            trip.forget_least(min(self._latest_four), now)
            self._proved = trip.least
        if self.phase is Phase.DRAIN:
            if in_flight <= self.packets or largest >= self._round_ends:
                # Everything sent before the drain has arrived, or so much that the rest is no queue.
                self.phase = Phase.HOLD
                self._hold_from = next_number
                self._held_least = float("inf")
            elif now - self._updated_at > max(1.0, 2 * self._was_standing):
                self._end_drain(now)
            return
        if self.phase is Phase.HOLD:
            self._held_least = min(self._held_least, trip.latest)
            if largest >= self._hold_from or trip.latest <= trip.least:
                self._end_drain(now)
                self._round_ends = next_number
            return
        if self.phase is Phase.STARTUP and not limited and min(self._latest_four) - trip.least > START_QUEUE_S:
            self.phase = Phase.CRUISE
            self._drained_at = now
            self.packets = max(LEAST_WINDOW, self.packets * trip.least / trip.standing)
        if largest < self._round_ends or now - self._updated_at < max(trip.standing, self._least_update_s()):
            return
        self._round_ends = next_number
        self._updated_at = now
        if trip.latest <= trip.least * 1.02 + 0.0005 and self._is_proved():
            # The empty path was seen just now: no drain is needed to see it.
            self._drained_at = now
        self._update(limited=limited, now=now)

    def _least_update_s(self) -> float:
        return LEAST_START_S if self.phase is Phase.STARTUP else LEAST_UPDATE_S

    def _queue_is_suspect(self) -> bool:
        least, standing = self._trip.least, self._trip.standing
        return least is not None and standing is not None and standing - least > SUSPECT_QUEUE_S + 0.25 * least

    def _is_proved(self) -> bool:
        """Whether the least round trip is the one seen when next to nothing of ours was on its way; otherwise it may
        hold a queue that never ran empty."""
        least = self._trip.least
        return least is not None and abs(least - self._proved) <= 0.15 * self._proved + self._scatter_s()

    def _scatter_s(self) -> float:
        """What the packets that a drain leaves on their way may take, and a radio's scatter."""
        return START_QUEUE_S / 3 + (LEAST_WINDOW - 1) / (self.capacity() or float("inf"))

    def _update(self, *, limited: bool, now: float) -> None:
        least, standing = self._trip.least, self._trip.standing
        assert least is not None
        assert standing is not None
        if self.phase is Phase.STARTUP:
            # It begins with little on its way.
            self._proved = least
            if not limited:
                self._start_faster(least, standing, now)
            return
        since_drain = now - self._drained_at
        self._suspected = self._suspected + 1 if self._queue_is_suspect() else 0
        if self._suspected >= 2 and since_drain > max(self._suspect_every, 4 * standing):
            self._begin_drain(now, suspicion=True)
            return
        every_round_trips = DRAIN_EVERY_ROUND_TRIPS if self._is_proved() else PROVE_EVERY_ROUND_TRIPS
        if since_drain > max(DRAIN_EVERY_S, every_round_trips * least):
            if not self._suspected and self._is_proved() and (limited or standing - least < QUEUE_S / 4):
                self._drained_at = now
            else:
                self._begin_drain(now, suspicion=self._suspected > 0)
                return
        empty = standing - least < QUEUE_S / 4 and not limited and now >= self._grow_from
        self._empty_rounds = self._empty_rounds + 1 if empty else 0
        if self._empty_rounds >= GROW_AFTER_ROUNDS:
            capacity = self.capacity() or 0.0
            if not self._growing or capacity > FULL_GROWTH * self._full_capacity:
                self._full_capacity, self._full_rounds = capacity, 0
            else:
                self._full_rounds += 1
            if self._full_rounds >= FULL_ROUNDS:
                self._growing = False
                self._empty_rounds = 0
                self._grow_from = now + GROW_AGAIN_S
                return
            self.packets = self._bounded(GROWTH * self.packets, least, standing)
            self._growing = True
            return
        self._growing = False
        wanted = 0.5 * self.packets + 0.5 * (self.packets * least / standing + self._queue(standing))
        if wanted < self.packets or not limited:
            self.packets = self._bounded(min(wanted, 2 * self.packets), least, standing)

    def _start_again(self, packets: float) -> None:
        """A route so much longer that what was measured on the one before does not tell how much it holds."""
        self.phase = Phase.STARTUP
        self.packets = min(MOST_WINDOW, max(START_WINDOW, packets))
        self._rates.clear()
        self._full_capacity, self._full_rounds = 0.0, 0

    def _start_faster(self, least: float, standing: float, now: float) -> None:
        """Double, unless the link has not become faster by it for some round trips (its queue is too short to see)."""
        capacity = self.capacity() or 0.0
        if capacity > FULL_GROWTH * self._full_capacity:
            self._full_capacity = capacity
            self._full_rounds = 0
        else:
            self._full_rounds += 1
        if self._full_rounds >= FULL_ROUNDS:
            self.phase = Phase.CRUISE
            self._drained_at = now
            self._grow_from = now + GROW_AGAIN_S
            self.packets = self._bounded(self.packets, least, standing)
        else:
            self.packets = max(self.packets, self._bounded(2 * self.packets, least, standing))

    def _queue(self, standing: float) -> float:
        # Losses leave holes in the queue as well as in what arrives.
        lost_s = LOSS_QUEUE_S * min(1.0, self._loss / LOSS_QUEUE_UP_TO)
        return self._shared(self._queue_s() + lost_s, self.packets / standing)

    def _queue_s(self) -> float:
        least = self._trip.least
        assert least is not None
        return min(QUEUE_S, max(SHORT_QUEUE_S, QUEUE_PER_ROUND_TRIP * least))

    def _shared(self, queue_s: float, packets_per_s: float) -> float:
        """Packets of queue: `queue_s` at this rate and a least number, less of both where others send too."""
        if self.queue_share == 1.0:
            return max(LEAST_QUEUE_PACKETS, queue_s * packets_per_s)
        relief = min(1.0, self._loss / SHARED_UP_TO_LOSS)
        share = self.queue_share + (1.0 - self.queue_share) * relief
        least = LEAST_SHARED_QUEUE_PACKETS * self.queue_share
        least += (LEAST_QUEUE_PACKETS - least) * relief
        return max(least, queue_s * share * packets_per_s)

    def _bounded(self, packets: float, least: float, standing: float) -> float:
        capacity = self.capacity()
        if capacity is not None:
            factor = RATE_BOUND if self.phase is Phase.CRUISE and not self._growing else START_RATE_BOUND
            # What waits for a batched acknowledgement is on its way too, and what is lost takes part in the window.
            pipe = capacity * (least + ACK_BATCH_S) / (1 - min(self._loss, MOST_LOSS))
            packets = min(packets, max(START_WINDOW, factor * pipe + self._queue(standing)))
        return min(MOST_WINDOW, max(LEAST_WINDOW, packets))

    def _begin_drain(self, now: float, *, suspicion: bool) -> None:
        least, standing = self._trip.least, self._trip.standing
        assert least is not None
        assert standing is not None
        self.phase = Phase.DRAIN
        self._suspicion = suspicion
        self._saved = self.packets
        self._was_standing = standing
        self._held_least = float("inf")
        self._updated_at = now
        self._to_the_bottom = not self._is_proved()
        drained = 0.0 if self._to_the_bottom else DRAIN_TO * self.packets * least / standing - DRAIN_PACKETS
        self.packets = max(LEAST_WINDOW - 1, drained)

    def _end_drain(self, now: float) -> None:
        least = self._trip.least
        assert least is not None
        held = self._held_least
        self.phase = Phase.CRUISE
        self._drained_at = self._updated_at = now
        # The queue is empty because of the drain: no reason to grow for the next round trips.
        self._grow_from = now + 3 * self._was_standing
        self._suspected = 0
        throughput = self._saved / self._was_standing
        if self._to_the_bottom and held != float("inf"):
            self._proved = held
        if (
            (self._suspicion or self._to_the_bottom)
            and held > 1.15 * least + self._scatter_s()
            and held != float("inf")
        ):
            self._trip.forget_least(held, now)
            self._suspect_every = SUSPECT_AGAIN_S
            if held > (least + self._was_standing) / 2:
                # Still long although our queue is gone: the route, not the queue, is longer.
                throughput = max(throughput, self.capacity() or 0.0)
                if held > RATE_WINDOW_S / 3:
                    self._start_again(2 * self._saved)
                    return
        elif self._suspicion:
            self._suspect_every = min(2 * self._suspect_every, MOST_SUSPECT_AGAIN_S)
        else:
            self.packets = self._saved
            return
        base = min(held, self._was_standing) if held != float("inf") else least
        queue = self._shared(self._queue_s(), throughput)
        # The rate may have changed with the route: no further ahead of what was measured than when starting.
        most = min(MOST_WINDOW, START_RATE_BOUND * max(START_WINDOW, self._saved))
        self.packets = min(most, max(LEAST_WINDOW, throughput * base + queue))

    def _saw_rate(self, rate: float, *, limited: bool, now: float) -> None:
        """Windowed maximum; a rate the application limited says nothing unless it is larger."""
        rates = self._rates
        while rates and rates[0][0] < now - RATE_WINDOW_S and not (limited and len(rates) == 1):
            rates.popleft()
        if limited and (not rates or rate < rates[0][1]):
            return
        while rates and rates[-1][1] <= rate:
            rates.pop()
        rates.append((now, rate))
