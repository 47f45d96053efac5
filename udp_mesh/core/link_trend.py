"""Whether the link to one peer gets better or worse: a sample per second -> direction and relative change per second.

The capacity is judged while enough is sent to measure it, else the round trip. The slope is the median of the slopes
between all pairs of samples (Sen, J. Am. Stat. Assoc. 63, 1968): up to 29 % of the samples may be wrong, as those of a
startup or of a short outage are. Logarithms are fitted, so that the slope is a relative change, and a time until a rate
is reached follows from it.
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from statistics import median

WINDOW_S = 30.0
"""A robot at 1 m/s drives a tenth of a radio's range in this time."""

SAMPLE_INTERVAL_S = 1.0
MIN_SAMPLES = 8
MIN_SPAN_S = 10.0
"""Fewer samples, or a shorter time, say nothing: a startup lasts some seconds."""

ENTER_CHANGE = math.log(1.5)
"""A change over the window that is a direction: capacity half as much again, or a third less."""

LEAVE_CHANGE = ENTER_CHANGE / 2
"""Below this the direction is steady again; in between it stays what it was."""

ROUND_TRIP_OFFSET_S = 0.020
"""Added to round trips, so that a few milliseconds of jitter on a short path are no change."""


class Direction(Enum):
    IMPROVING = "improving"
    STEADY = "steady"
    WORSENING = "worsening"


class Measure(Enum):
    CAPACITY = "capacity"
    ROUND_TRIP = "round-trip"


@dataclass(frozen=True, slots=True)
class Trend:
    """The trend over the last `WINDOW_S`."""

    direction: Direction
    measure: Measure
    """What was judged."""
    change_per_s: float
    """Relative change per second, as a logarithm; negative: worsening. -0.02 is a loss of 2 % per second: a capacity c
    falls to r in log(c / r) / 0.02 seconds if that continues."""


def median_slope(samples: Iterable[tuple[float, float]]) -> float | None:
    """Median of the slopes between all pairs of (time, value); None with fewer than two times."""
    points = list(samples)
    slopes = [
        (value - earlier) / (at - before)
        for index, (at, value) in enumerate(points)
        for before, earlier in points[:index]
        if at > before
    ]
    return median(slopes) if slopes else None


def next_direction(before: Direction, change: float) -> Direction:
    """The direction after a logarithmic `change` over the window (positive: better), with hysteresis."""
    if change >= ENTER_CHANGE or (before is Direction.IMPROVING and change >= LEAVE_CHANGE):
        return Direction.IMPROVING
    if change <= -ENTER_CHANGE or (before is Direction.WORSENING and change <= -LEAVE_CHANGE):
        return Direction.WORSENING
    return Direction.STEADY


class LinkTrend:
    """The samples of one link. `trend` is None while too little was acknowledged within the window."""

    __slots__ = ("_delivered_packets", "_sampled_at", "_samples", "trend")

    def __init__(self) -> None:
        self.trend: Trend | None = None
        self._samples: dict[Measure, deque[tuple[float, float]]] = {measure: deque() for measure in Measure}
        self._sampled_at = float("-inf")
        self._delivered_packets = 0

    def feed(self, capacity: float | None, round_trip_s: float | None, delivered_packets: int, now: float) -> None:
        """Call at least every second. `capacity` in any unit, None unless measured now; `delivered_packets` is a
        running total: without new ones there is nothing to judge."""
        if now - self._sampled_at < SAMPLE_INTERVAL_S:
            return
        self._sampled_at = now
        if delivered_packets != self._delivered_packets:
            self._delivered_packets = delivered_packets
            if capacity:
                self._samples[Measure.CAPACITY].append((now, math.log(capacity)))
            if round_trip_s is not None:
                value = -math.log(round_trip_s + ROUND_TRIP_OFFSET_S)
                self._samples[Measure.ROUND_TRIP].append((now, value))
        self.trend = self._judge(now)

    def _judge(self, now: float) -> Trend | None:
        for measure, samples in self._samples.items():
            while samples and samples[0][0] < now - WINDOW_S:
                samples.popleft()
            if len(samples) < MIN_SAMPLES or samples[-1][0] - samples[0][0] < MIN_SPAN_S:
                continue
            slope = median_slope(samples)
            if slope is None:
                continue
            before = Direction.STEADY
            if self.trend is not None and self.trend.measure is measure:
                before = self.trend.direction
            return Trend(next_direction(before, slope * WINDOW_S), measure, slope)
        return None
