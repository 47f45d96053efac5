"""Delay-based congestion control: round trip times decide, loss does not (radio loss is not congestion).

1. Startup doubles the window once per round trip until the round trip has grown by `STARTUP_QUEUE_S`, or by
   an eighth on a long path.
2. Then, once per round trip: w <- w/2 + (w * min_rtt / windowed_rtt + a) / 2, where a is `QUEUE_S` worth of packets
   (less on a short path, more on a lossy one). The window settles where the sender keeps exactly that much queue at the
   bottleneck.
3. w never exceeds what the measured delivery rate needs, plus a, by much, and growth that delivers nothing more stops:
   a queue too short to show as delay is not overrun. A window that is used up without a queue grows (`growth`).
4. A *drain* empties the queue for one round trip, so that the minimum RTT is seen again: after `DRAIN_INTERVAL_S`
   without seeing it, and as soon as the round trip is longer than our own queue explains. If it stays long with an
   empty queue, the route has changed: the window moves at once to the new round trip times the delivery rate, however
   far. On a route too long for that rate to be its own, startup begins again.
5. The minimum RTT is *verified* if it was seen with next to nothing in flight. Once it differs (the path changed, or no
   drain has seen the empty path for long) the next drain goes down to `MIN_CWND` - 1 packets: otherwise a standing
   queue would be taken for the path, and its losses for radio loss.
6. While others keep the queue filled, whatever drains find (`competition`), the window is TCP's instead.

Step 2 is based on FAST TCP (Jin, Wei, Low 2004), steps 3 and 4 on BBR's bandwidth model (Cardwell et al. 2016).
"""

from collections import deque
from enum import Enum

from udp_mesh.core.congestion.competition import Competition
from udp_mesh.core.congestion.delivery_rate import RATE_WINDOW_S, DeliveryRate
from udp_mesh.core.congestion.growth import GROWTH_PAUSE_S, FullLink, Growth
from udp_mesh.core.congestion.queue_target import QUEUE_S, loss_queue_s, queue_packets, target_queue_s
from udp_mesh.core.congestion.rtt import MIN_WINDOWED_RTT_S, RttEstimator

STARTUP_QUEUE_S = 0.006
STARTUP_QUEUE_PER_ROUND_TRIP = 0.125
MAX_STARTUP_QUEUE_S = 0.030
"""RTT growth that ends startup: more than a radio's jitter, less than the slack of an urgent message. On a long path a
doubled window leaves in bursts that are themselves such a queue, and ending too early costs seconds; an eighth of the
round trip was measured."""

MIN_CWND = 4.0
"""Packets: below this, a lost packet has too few successors to be detected without a timeout. On a lossy path so many
must be acknowledged: packets and acknowledgments are both lost, so the minimum is this divided by (1 - loss)²."""

MIN_CWND_SLACK = 1.02
"""The loss changes between two updates: a window of so many times the minimum is the smallest."""

MAX_CWND = 8192.0
"""Packets: 92 Mbit at 1400 B, more than any link of these robots needs. Bounds the state per packet."""

PACE_GAIN = 1.25
"""The window, not pacing, limits what is in flight: pacing only spreads it."""

CAPACITY_GAIN = 1.05
"""Pacing this much above the measured rate detects a faster link without building a queue."""

LOSS_GAIN = 0.3
"""Plus this fraction of the loss rate: its estimate is noisy, and pacing too slowly costs throughput."""

MAX_LOSS = 0.35
"""The measured rate counts deliveries; lost packets are added, up to this fraction of what is sent."""

INITIAL_CWND = 10.0
"""Initial window in packets (RFC 6928)."""

MIN_UPDATE_S = MIN_WINDOWED_RTT_S
"""Minimum update interval on links with a shorter round trip: until then the windowed RTT still reflects the previous
window."""

MIN_STARTUP_UPDATE_S = 0.004
"""The same during startup, when only growth counts."""

DRAIN_INTERVAL_S = 2.0
DRAIN_ROUND_TRIPS = 15.0
"""Minimum time between two drains: each costs about a quarter of a round trip of throughput."""

UNVERIFIED_DRAIN_ROUND_TRIPS = 4.0
"""The same while the minimum RTT is not verified and everything based on it may be wrong."""

DRAIN_FRACTION = 0.95
DRAIN_PACKETS = 3
"""Fraction of the pipe kept full during a drain, less these packets: on a short path a burst of them is the queue."""

SERIALIZED_MIN_RTT_S = 0.04
"""From this minimum RTT on, a packet's own serialization time counts as no queue."""

RATE_BOUND = 1.2
STARTUP_RATE_BOUND = 2.5
"""Upper bounds of the window relative to what the measured rate needs; growth has to run ahead of the measurement."""

ACK_BATCH_S = 0.008
"""About how long batched acknowledgments keep packets in the window beyond the round trip."""

COMPETITIVE_DRAIN_INTERVAL_S = 4.0
"""Minimum time between two drains in competition: each gives the queue to the other flow for a round trip or two."""

SUSPECT_QUEUE_S = 0.015
"""More queueing than our own window explains."""

SUSPECT_DRAIN_INTERVAL_S = 0.3
MAX_SUSPECT_DRAIN_INTERVAL_S = 4.0
"""Minimum time between two drains on suspicion, doubled each time one finds nothing."""


def _startup_queue_s(min_rtt: float) -> float:
    return max(STARTUP_QUEUE_S, min(MAX_STARTUP_QUEUE_S, STARTUP_QUEUE_PER_ROUND_TRIP * min_rtt))


class Phase(Enum):
    STARTUP = 1
    CRUISE = 2
    DRAIN = 3
    """Waiting until few enough packets are in flight."""
    HOLD = 4
    """The queue is empty: waiting for the round trip of a packet sent now."""


class DelayBasedController:
    """The controller described in the module's docstring."""

    __slots__ = (
        "_competition",
        "_cwnd_before_drain",
        "_drain_on_suspicion",
        "_drained_at",
        "_full_drain",
        "_growth",
        "_hold_from_number",
        "_hold_min_rtt",
        "_last_rtts",
        "_loss",
        "_rate",
        "_round_ends_at",
        "_rtt",
        "_startup",
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
        self._rate = DeliveryRate()
        self._uncontended_acks = 0
        self._verified_min_rtt = 0.0
        self._full_drain = False
        self._round_ends_at = 0
        self._updated_at = 0.0
        self._drained_at = 0.0
        self._startup = FullLink()
        self._competition = Competition()
        self._growth = Growth()
        self._loss = 0.0
        self._cwnd_before_drain = INITIAL_CWND
        self._windowed_rtt_before_drain = 0.0
        self._hold_from_number = 0
        self._hold_min_rtt = float("inf")
        self._drain_on_suspicion = False
        self._suspect_rounds = 0
        self._suspect_interval_s = SUSPECT_DRAIN_INTERVAL_S

    def capacity_packets_per_s(self) -> float | None:
        return self._rate.maximum

    def is_capacity_current(self, now: float) -> bool:
        return self._rate.is_current(now)

    def assume_delivery(self) -> bool:
        # A drain wants the queue empty.
        return self.phase in (Phase.STARTUP, Phase.CRUISE) and self._rate.maximum is not None

    def is_queue_explained(self) -> bool:
        return not self._unexplained_queue()

    @property
    def undrained_cwnd(self) -> float:
        return self._cwnd_before_drain if self.phase in (Phase.DRAIN, Phase.HOLD) else self.cwnd

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
            if capacity is None or self._growth.active or self._competition.is_on
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
        lost: int,
        loss: float,
        now: float,
    ) -> None:
        rtt = self._rtt
        if rtt.latest_rtt is None or rtt.min_rtt is None or rtt.windowed_rtt is None:
            return
        self._loss = loss
        if lost:
            self._competition.on_lost(lost)
        if rate is not None:
            self._rate.add(rate, app_limited=app_limited, now=now)
            rtt.packet_s = 1.0 / (self._rate.maximum or float("inf"))
        self._last_rtts.append(rtt.latest_rtt)
        self._uncontended_acks = self._uncontended_acks + 1 if ahead < MIN_CWND - 1 else 0
        if app_limited and self._uncontended_acks >= 4 and min(self._last_rtts) > 1.15 * rtt.min_rtt + STARTUP_QUEUE_S:
            # None of the four had more of our packets ahead of it than a drain leaves: the path itself is longer now.
            # (A pausing application alone proves nothing: a link that became slow still holds what was sent before.)
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
        growth_s = min(self._last_rtts) - rtt.min_rtt
        if self.phase is Phase.STARTUP and not app_limited and growth_s > _startup_queue_s(rtt.min_rtt):
            self.phase = Phase.CRUISE
            self._drained_at = now
            self.cwnd = max(MIN_CWND, self.cwnd * rtt.min_rtt / rtt.windowed_rtt)
        if largest < self._round_ends_at or now - self._updated_at < max(rtt.windowed_rtt, self._min_update_s()):
            return
        self._round_ends_at = next_number
        self._updated_at = now
        if rtt.latest_rtt <= rtt.min_rtt * 1.02 + 0.0005 and self._min_rtt_is_verified():
            # The empty path was just seen: no drain is needed.
            self._drained_at = now
        self._update(app_limited=app_limited, now=now)

    def _min_update_s(self) -> float:
        return MIN_STARTUP_UPDATE_S if self.phase is Phase.STARTUP else MIN_UPDATE_S

    def _unexplained_queue(self) -> bool:
        min_rtt, windowed_rtt = self._rtt.min_rtt, self._rtt.windowed_rtt
        if min_rtt is None or windowed_rtt is None:
            return False
        unexplained_s = windowed_rtt - min_rtt - SUSPECT_QUEUE_S - 0.25 * min_rtt
        if unexplained_s <= 0.0:
            return False
        # On a short lossy path the smallest window is a queue by itself.
        return unexplained_s > self._min_cwnd() / (self._rate.maximum or float("inf")) - min_rtt

    def _min_rtt_is_verified(self) -> bool:
        """Whether the minimum RTT was seen with next to nothing in flight; otherwise it may include a standing
        queue."""
        min_rtt = self._rtt.min_rtt
        return (
            min_rtt is not None
            and abs(min_rtt - self._verified_min_rtt) <= 0.15 * self._verified_min_rtt + self._jitter_s()
        )

    def _jitter_s(self) -> float:
        """Serialization time of the packets left in flight by a drain, plus a radio's jitter."""
        return STARTUP_QUEUE_S / 3 + (MIN_CWND - 1) / (self._rate.maximum or float("inf"))

    def _update(self, *, app_limited: bool, now: float) -> None:
        min_rtt, windowed_rtt = self._rtt.min_rtt, self._rtt.windowed_rtt
        assert min_rtt is not None
        assert windowed_rtt is not None
        if self.phase is Phase.STARTUP:
            # Startup begins with little in flight.
            self._verified_min_rtt = min_rtt
            if not app_limited:
                self._grow_startup(min_rtt, windowed_rtt, now)
            return
        self._competition.on_round(min_rtt, loss=self._loss, now=now)
        since_drain = now - self._drained_at
        if self._competition.is_on:
            if since_drain > max(COMPETITIVE_DRAIN_INTERVAL_S, DRAIN_ROUND_TRIPS * windowed_rtt):
                self._begin_drain(now, suspicion=True)
            elif not app_limited:
                self.cwnd = min(MAX_CWND, max(MIN_CWND, self._competition.window(self.cwnd, windowed_rtt)))
            return
        self._suspect_rounds = self._suspect_rounds + 1 if self._unexplained_queue() else 0
        if self._suspect_rounds >= 2 and since_drain > max(self._suspect_interval_s, 4 * windowed_rtt):
            self._begin_drain(now, suspicion=True)
            return
        is_verified = self._min_rtt_is_verified() and not self._competition.is_suspected
        every_round_trips = DRAIN_ROUND_TRIPS if is_verified else UNVERIFIED_DRAIN_ROUND_TRIPS
        interval_s = DRAIN_INTERVAL_S / 2 if self._competition.is_suspected else DRAIN_INTERVAL_S
        # The smallest window stays as it is, whatever a drain finds.
        is_smallest = self.cwnd <= MIN_CWND_SLACK * self._min_cwnd()
        if since_drain > max(interval_s, every_round_trips * min_rtt) and not is_smallest:
            if not self._suspect_rounds and is_verified and (app_limited or windowed_rtt - min_rtt < QUEUE_S / 4):
                self._drained_at = now
            else:
                self._begin_drain(now, suspicion=self._suspect_rounds > 0)
                return
        is_empty = windowed_rtt - min_rtt < self._empty_slack_s() and not app_limited
        capacity = self.capacity_packets_per_s() or 0.0
        packets = self._growth.packets(self.cwnd, capacity, min_rtt, is_empty=is_empty, now=now)
        if packets is not None:
            if packets:
                self.cwnd = self._bounded(self.cwnd + packets, min_rtt, windowed_rtt)
            return
        target = 0.5 * self.cwnd + 0.5 * (self.cwnd * min_rtt / windowed_rtt + self._queue_packets(windowed_rtt))
        if target < self.cwnd or not app_limited:
            self.cwnd = self._bounded(min(target, 2 * self.cwnd), min_rtt, windowed_rtt)

    def _restart(self, packets: float) -> None:
        """Start up again on a route so much longer that the measured rate says nothing about its capacity."""
        self.phase = Phase.STARTUP
        self.cwnd = min(MAX_CWND, max(INITIAL_CWND, packets))
        self._rate.clear()
        self._startup.restart(0.0)

    def _grow_startup(self, min_rtt: float, windowed_rtt: float, now: float) -> None:
        """Double the window, unless that has not made the link faster for some round trips (its queue is too short to
        see)."""
        if self._startup.is_full(self.capacity_packets_per_s() or 0.0):
            self.phase = Phase.CRUISE
            self._drained_at = now
            self._growth.pause(now + GROWTH_PAUSE_S)
            self.cwnd = self._bounded(self.cwnd, min_rtt, windowed_rtt)
        else:
            self.cwnd = max(self.cwnd, self._bounded(2 * self.cwnd, min_rtt, windowed_rtt))

    def _empty_slack_s(self) -> float:
        """Round trips this much above the minimum show no queue.

        On a longer path the minimum of a small packet stays valid for many seconds; those that follow take the
        serialization time of a full one more without any queue.
        """
        min_rtt = self._rtt.min_rtt
        assert min_rtt is not None
        if min_rtt < SERIALIZED_MIN_RTT_S:
            return QUEUE_S / 4
        return min(STARTUP_QUEUE_S, QUEUE_S / 4 + 1.0 / (self._rate.maximum or float("inf")))

    def _queue_packets(self, windowed_rtt: float) -> float:
        return self._shared_queue(self._target_queue_s() + loss_queue_s(self._loss), self.cwnd / windowed_rtt)

    def _target_queue_s(self) -> float:
        min_rtt = self._rtt.min_rtt
        assert min_rtt is not None
        return target_queue_s(min_rtt)

    def _shared_queue(self, queue_s: float, packets_per_s: float) -> float:
        return queue_packets(queue_s, packets_per_s, queue_share=self.queue_share, loss=self._loss)

    def _bounded(self, packets: float, min_rtt: float, windowed_rtt: float) -> float:
        capacity = self.capacity_packets_per_s()
        if capacity is not None:
            factor = RATE_BOUND if self.phase is Phase.CRUISE and not self._growth.active else STARTUP_RATE_BOUND
            # Packets waiting for a batched acknowledgment are in flight too, and lost ones occupy the window.
            pipe = capacity * (min_rtt + ACK_BATCH_S) / (1 - min(self._loss, MAX_LOSS))
            packets = min(packets, max(INITIAL_CWND, factor * pipe + self._queue_packets(windowed_rtt)))
        return min(MAX_CWND, max(self._min_cwnd(), packets))

    def _min_cwnd(self) -> float:
        # Other senders keep the channel busy while a loss goes unnoticed, and their minimums add up to one queue.
        return MIN_CWND if self.queue_share < 1.0 else MIN_CWND / (1 - min(self._loss, MAX_LOSS)) ** 2

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
        self._full_drain = not self._min_rtt_is_verified() or self._competition.is_suspected
        drained = 0.0 if self._full_drain else DRAIN_FRACTION * self.cwnd * min_rtt / windowed_rtt - DRAIN_PACKETS
        self.cwnd = max(MIN_CWND - 1, drained)

    def _end_drain(self, now: float) -> None:
        min_rtt = self._rtt.min_rtt
        assert min_rtt is not None
        hold_min_rtt = self._hold_min_rtt
        self.phase = Phase.CRUISE
        self._drained_at = self._updated_at = now
        # The drain emptied the queue: no reason to grow for the next round trips.
        self._growth.pause(now + 3 * self._windowed_rtt_before_drain)
        self._suspect_rounds = 0
        throughput = self._cwnd_before_drain / self._windowed_rtt_before_drain
        # The rate may have changed with the route: stay within the bound of startup.
        max_cwnd = STARTUP_RATE_BOUND * max(INITIAL_CWND, self._cwnd_before_drain)
        if self._full_drain and hold_min_rtt != float("inf"):
            self._verified_min_rtt = hold_min_rtt
        if hold_min_rtt != float("inf"):
            self._competition.on_drained(hold_min_rtt, others_send=self.queue_share < 1.0, now=now)
            if self._competition.is_on:
                self._rtt.reset_min_rtt(hold_min_rtt, now)
                self.cwnd = max(self._cwnd_before_drain, INITIAL_CWND)
                return
        if (
            (self._drain_on_suspicion or self._full_drain)
            and hold_min_rtt > 1.15 * min_rtt + self._jitter_s()
            and hold_min_rtt != float("inf")
        ):
            self._rtt.reset_min_rtt(hold_min_rtt, now)
            self._suspect_interval_s = SUSPECT_DRAIN_INTERVAL_S
            if hold_min_rtt > (min_rtt + self._windowed_rtt_before_drain) / 2:
                # Still long although our queue is gone: the route, not the queue, is longer. The rate was measured
                # within the last seconds, mostly on the shorter route, so it is known however much the window grows.
                throughput = max(throughput, self.capacity_packets_per_s() or 0.0)
                max_cwnd = MAX_CWND
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
        self.cwnd = min(max_cwnd, MAX_CWND, max(self._min_cwnd(), throughput * base + queue))
