"""The round trip to one peer: a sample per acknowledgement -> smoothed, least and standing round trip.

*Least* is the path without queues (minimum over about 5 s), *standing* is what packets take now, free of single late
acknowledgements (minimum over half a round trip, at least 20 ms). Smoothed and variation as RFC 6298.
"""

from collections import deque

MIN_RTT_WINDOW_S = 5.0
"""Longer hides a route that became longer for that time; shorter forgets the empty path between two drains."""

MIN_RTT_WINDOW_ROUND_TRIPS = 37.5
"""The same on long paths, 2.5 drains of 15 round trips apart."""

MIN_WINDOWED_RTT_S = 0.020
"""At least this much: fast links acknowledge in bursts of a scheduler's tick."""

INITIAL_PTO_S = 0.25
"""Until the first sample: the longest wait between probes of a silent peer."""

MIN_PTO_ROUND_TRIPS = 2.0
"""Round trips that an answer is always waited for: to send all again before it can be acknowledged would keep a slow
path as slow as it is."""

MAX_RTT_OUTLIER_S = 2.0
"""A round trip longer than this, and than twice what is usual, counts as that: a process or machine that stood still in
the middle would otherwise be taken for a path on which a packet in some seconds is enough."""

TIMER_GRANULARITY_S = 0.005
"""Added to timeouts: drivers and radios are late by this much without anything being lost."""


class RttEstimator:
    """All times in seconds; None before the first sample."""

    __slots__ = ("_min_samples", "_windowed_samples", "latest_rtt", "min_rtt", "rttvar", "smoothed_rtt", "windowed_rtt")

    def __init__(self) -> None:
        self.smoothed_rtt: float | None = None
        self.rttvar = 0.0
        self.latest_rtt: float | None = None
        self.min_rtt: float | None = None
        self.windowed_rtt: float | None = None
        self._min_samples: deque[tuple[float, float]] = deque()
        self._windowed_samples: deque[tuple[float, float]] = deque()

    def sample(self, round_trip_s: float, now: float) -> None:
        """One measured round trip, without the time the peer held its acknowledgement back."""
        round_trip_s = min(round_trip_s, max(MAX_RTT_OUTLIER_S, 2 * (self.smoothed_rtt or 0.0)))
        self.latest_rtt = round_trip_s
        if self.smoothed_rtt is None:
            self.smoothed_rtt = round_trip_s
            self.rttvar = round_trip_s / 2
        else:
            self.rttvar += (abs(self.smoothed_rtt - round_trip_s) - self.rttvar) / 4
            self.smoothed_rtt += (round_trip_s - self.smoothed_rtt) / 8
        min_window_s = max(MIN_RTT_WINDOW_S, MIN_RTT_WINDOW_ROUND_TRIPS * (self.min_rtt or 0.0))
        self.min_rtt = _minimum(self._min_samples, round_trip_s, now, min_window_s)
        self.windowed_rtt = _minimum(
            self._windowed_samples, round_trip_s, now, max(MIN_WINDOWED_RTT_S, self.smoothed_rtt / 2)
        )

    def reset_min_rtt(self, round_trip_s: float, now: float) -> None:
        """The path changed: its least round trip is now this."""
        self._min_samples.clear()
        self._min_samples.append((now, round_trip_s))
        self.min_rtt = round_trip_s

    def pto_s(self, ack_delay_s: float, max_s: float = float("inf")) -> float:
        """How long after the last progress the oldest packet or its acknowledgement must be lost; at most `max_s` on
        a path that is not slow itself."""
        if self.smoothed_rtt is None:
            return min(max_s, INITIAL_PTO_S)
        timeout_s = self.smoothed_rtt + max(4 * self.rttvar, TIMER_GRANULARITY_S) + ack_delay_s
        return min(timeout_s, max(max_s, MIN_PTO_ROUND_TRIPS * self.smoothed_rtt))


def _minimum(samples: deque[tuple[float, float]], value: float, now: float, window_s: float) -> float:
    """Add `value` to a sliding minimum; returns the minimum of the window. Amortized constant time."""
    while samples and samples[-1][1] >= value:
        samples.pop()
    samples.append((now, value))
    while samples[0][0] < now - window_s:
        samples.popleft()
    return samples[0][1]
