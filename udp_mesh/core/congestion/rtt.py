"""The round trip to one peer: a sample per acknowledgement -> smoothed, least and standing round trip.

*Least* is the path without queues (minimum over about 5 s), *standing* is what packets take now, free of single late
acknowledgements (minimum over half a round trip, at least 20 ms). Smoothed and variation as RFC 6298.
"""

from collections import deque

LEAST_WINDOW_S = 5.0
"""Longer hides a route that became longer for that time; shorter forgets the empty path between two drains."""

LEAST_WINDOW_ROUND_TRIPS = 37.5
"""The same on long paths, 2.5 drains of 15 round trips apart."""

STANDING_WINDOW_S = 0.020
"""At least this much: fast links acknowledge in bursts of a scheduler's tick."""

INITIAL_TIMEOUT_S = 0.25
"""Until the first sample: the longest wait between probes of a silent peer."""

SLOW_ROUND_TRIPS = 2.0
"""Round trips that an answer is always waited for: to send all again before it can be acknowledged would keep a slow
path as slow as it is."""

MOST_SURPRISE_S = 2.0
"""A round trip longer than this, and than twice what is usual, counts as that: a process or machine that stood still in
the middle would otherwise be taken for a path on which a packet in some seconds is enough."""

TIMER_GRAIN_S = 0.005
"""Added to timeouts: drivers and radios are late by this much without anything being lost."""


class RoundTrip:
    """All times in seconds; None before the first sample."""

    __slots__ = ("_least", "_recent", "latest", "least", "smoothed", "standing", "variation")

    def __init__(self) -> None:
        self.smoothed: float | None = None
        self.variation = 0.0
        self.latest: float | None = None
        self.least: float | None = None
        self.standing: float | None = None
        self._least: deque[tuple[float, float]] = deque()
        self._recent: deque[tuple[float, float]] = deque()

    def sample(self, round_trip_s: float, now: float) -> None:
        """One measured round trip, without the time the peer held its acknowledgement back."""
        round_trip_s = min(round_trip_s, max(MOST_SURPRISE_S, 2 * (self.smoothed or 0.0)))
        self.latest = round_trip_s
        if self.smoothed is None:
            self.smoothed = round_trip_s
            self.variation = round_trip_s / 2
        else:
            self.variation += (abs(self.smoothed - round_trip_s) - self.variation) / 4
            self.smoothed += (round_trip_s - self.smoothed) / 8
        least_window = max(LEAST_WINDOW_S, LEAST_WINDOW_ROUND_TRIPS * (self.least or 0.0))
        self.least = _minimum(self._least, round_trip_s, now, least_window)
        self.standing = _minimum(self._recent, round_trip_s, now, max(STANDING_WINDOW_S, self.smoothed / 2))

    def forget_least(self, round_trip_s: float, now: float) -> None:
        """The path changed: its least round trip is now this."""
        self._least.clear()
        self._least.append((now, round_trip_s))
        self.least = round_trip_s

    def timeout(self, ack_delay_s: float, most_s: float = float("inf")) -> float:
        """How long after the last progress the oldest packet or its acknowledgement must be lost; at most `most_s` on
        a path that is not slow itself."""
        if self.smoothed is None:
            return min(most_s, INITIAL_TIMEOUT_S)
        timeout_s = self.smoothed + max(4 * self.variation, TIMER_GRAIN_S) + ack_delay_s
        return min(timeout_s, max(most_s, SLOW_ROUND_TRIPS * self.smoothed))


def _minimum(samples: deque[tuple[float, float]], value: float, now: float, window_s: float) -> float:
    """Add `value` to a sliding minimum; returns the minimum of the window. Amortized constant time."""
    while samples and samples[-1][1] >= value:
        samples.pop()
    samples.append((now, value))
    while samples[0][0] < now - window_s:
        samples.popleft()
    return samples[0][1]
