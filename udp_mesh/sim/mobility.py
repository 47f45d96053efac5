"""Trajectories of robots, and the frame loss between two points."""

from __future__ import annotations

import itertools
import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

Point = tuple[float, float]
"""Metres."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A path in the plane: at `points[i]` at `times_s[i]`, with linear interpolation in between."""

    times_s: tuple[float, ...]
    points: tuple[Point, ...]

    def at(self, now: float) -> Point:
        """The position at a time; before the first and after the last time, the first and last point."""
        index = bisect_right(self.times_s, now)
        if index == 0:
            return self.points[0]
        if index == len(self.times_s):
            return self.points[-1]
        before, after = self.times_s[index - 1], self.times_s[index]
        share = (now - before) / (after - before)
        (x0, y0), (x1, y1) = self.points[index - 1], self.points[index]
        return (x0 + (x1 - x0) * share, y0 + (y1 - y0) * share)


@dataclass(frozen=True, slots=True)
class Wall:
    """A straight wall: each one between two radios adds `loss` to the frame loss."""

    a: Point
    b: Point
    loss: float = 1.0


@dataclass(frozen=True, slots=True)
class PathLoss:
    """Loss by distance: `least_loss` up to `good_m`, then rising linearly to 1 at `range_m`."""

    good_m: float = 80.0
    range_m: float = 160.0
    least_loss: float = 0.01
    walls: tuple[Wall, ...] = ()

    def loss(self, a: Point, b: Point) -> float:
        """The probability, 0 to 1, that a frame between two points is lost; 1 means out of range."""
        distance_m = math.dist(a, b)
        if distance_m >= self.range_m:
            return 1.0
        beyond = max(0.0, distance_m - self.good_m) / max(self.range_m - self.good_m, 1e-9)
        loss = self.least_loss + (1.0 - self.least_loss) * beyond
        return min(1.0, loss + sum(wall.loss for wall in self.walls if _segments_cross(a, b, wall.a, wall.b)))


def _side(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _segments_cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the segments a-b and c-d properly intersect."""
    return _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0


def stationary(point: Point) -> Trajectory:
    """The trajectory of something that does not move."""
    return Trajectory((0.0,), (point,))


def trajectory(way_points: Sequence[tuple[float, Point]]) -> Trajectory:
    """A trajectory through (seconds, point) pairs. Raises ValueError unless the times increase."""
    times = tuple(time_s for time_s, _ in way_points)
    if not times or any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("waypoints: expected at least one, with increasing times")
    return Trajectory(times, tuple(point for _, point in way_points))
