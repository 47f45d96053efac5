"""Where robots are and how well they hear each other there: way points in, frame loss between two places out."""

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
    """A path through the plane: at `times_s[i]` the thing is at `points[i]`, in between on the straight line."""

    times_s: tuple[float, ...]
    points: tuple[Point, ...]

    def at(self, now: float) -> Point:
        """Before the first time it stands at the first point, after the last at the last."""
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
    """A straight piece of rock: each one between two radios adds `loss` to a frame's loss."""

    a: Point
    b: Point
    loss: float = 1.0


@dataclass(frozen=True, slots=True)
class PathLoss:
    """How loss grows with distance: `least_loss` up to `good_m`, then in a straight line to 1 at `range_m`."""

    good_m: float = 80.0
    range_m: float = 160.0
    least_loss: float = 0.01
    walls: tuple[Wall, ...] = ()

    def loss(self, a: Point, b: Point) -> float:
        """The chance, 0 to 1, that one frame between two places is lost; 1 means that they do not hear each other."""
        distance_m = math.dist(a, b)
        if distance_m >= self.range_m:
            return 1.0
        beyond = max(0.0, distance_m - self.good_m) / max(self.range_m - self.good_m, 1e-9)
        loss = self.least_loss + (1.0 - self.least_loss) * beyond
        return min(1.0, loss + sum(wall.loss for wall in self.walls if _segments_cross(a, b, wall.a, wall.b)))


def _side(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _segments_cross(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Whether the pieces a-b and c-d properly cross."""
    return _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0


def stationary(point: Point) -> Trajectory:
    """The course of what does not move."""
    return Trajectory((0.0,), (point,))


def trajectory(way_points: Sequence[tuple[float, Point]]) -> Trajectory:
    """A course through (seconds, place) pairs; raises ValueError unless the times rise."""
    times = tuple(time_s for time_s, _ in way_points)
    if not times or any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise ValueError("way points: expected at least one, with rising times")
    return Trajectory(times, tuple(point for _, point in way_points))
