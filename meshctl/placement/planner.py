"""Beacons along a route: the fewest that keep a margin everywhere, and where. Pure.

The route is cut into steps. A beacon at step i covers the steps up to `reach[i]`, the last one before the margin first
falls below what is asked for. The next beacon may stand at any step that the last one covers; taking the one that
reaches farthest gives the fewest beacons, because every beacon covers a whole stretch (as when covering an interval).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

from meshctl.placement.margin import UNMEASURED_FADE_DB
from meshctl.placement.occupancy_map import OccupancyMap
from meshctl.placement.path_loss import Point, RadioModel, Wall, walls_between

MAX_STEPS = 300
MIN_STEP_M = 1.0


class Terrain(Protocol):
    """The obstacles between two places."""

    def walls(self, a: Point, b: Point) -> Sequence[Wall]: ...


@dataclass(frozen=True, slots=True)
class Walls:
    """A terrain of straight walls."""

    segments: tuple[Wall, ...]

    def walls(self, a: Point, b: Point) -> Sequence[Wall]:
        return walls_between(self.segments, a, b, touching=True)


@dataclass(frozen=True, slots=True)
class MappedTerrain:
    """A terrain of an occupancy map; what is not free costs as `wall` each time that the line enters it."""

    occupancy: OccupancyMap
    wall: Wall

    def walls(self, a: Point, b: Point) -> Sequence[Wall]:
        return (self.wall,) * self.occupancy.wall_count(a, b)


@dataclass(frozen=True, slots=True)
class Beacon:
    """A planned beacon at `depth_m` of the route, and the margin of its link to the one before (or the base)."""

    depth_m: float
    at: Point
    margin_db: float


@dataclass(frozen=True, slots=True)
class PlacementPlan:
    """`covered_m` is how much of the route has the margin; less than `length_m` if no place helps, or the beacons are
    too few. `steps` are the places of the route with their margin to the best node."""

    length_m: float
    covered_m: float
    margin_db: float
    beacons: tuple[Beacon, ...]
    steps: tuple[tuple[float, Point, float], ...]

    @property
    def is_complete(self) -> bool:
        return self.covered_m >= self.length_m - 1e-6


def plan(
    terrain: Terrain,
    air: RadioModel,
    route: Sequence[Point],
    *,
    margin_db: float = UNMEASURED_FADE_DB,
    beacons: int | None = None,
    tx_power_dbm: float | None = None,
) -> PlacementPlan:
    """The fewest beacons for the route from the base at its first point; at most `beacons` of them.

    `margin_db` is beyond the ratio at which half of the frames are lost.
    """
    places = _steps(route)
    power_dbm = air.tx_power_dbm if tx_power_dbm is None else tx_power_dbm
    needed_dbm = air.noise_dbm + air.required_snr_db

    def margin(i: int, j: int) -> float:
        a, b = places[i][1], places[j][1]
        return air.power_dbm(math.dist(a, b), power_dbm, terrain.walls(a, b)) - needed_dbm

    reach = [_reach(i, len(places), margin, margin_db) for i in range(len(places))]
    chosen: list[int] = []
    last, covered = 0, reach[0]
    while covered < len(places) - 1 and (beacons is None or len(chosen) < beacons):
        best = max(range(last + 1, covered + 1), key=lambda i: (reach[i], -i), default=last)
        if reach[best] <= covered:
            break
        chosen.append(best)
        last, covered = best, reach[best]
    nodes = [0, *chosen]
    found = tuple(Beacon(*places[i], margin(before, i)) for before, i in pairwise(nodes))
    margins = tuple(
        (depth, at, max(margin(node, j) for node in _near(nodes, j))) for j, (depth, at) in enumerate(places)
    )
    return PlacementPlan(places[-1][0], places[covered][0], margin_db, found, margins)


def _near(nodes: Sequence[int], j: int) -> list[int]:
    """The nodes on both sides of a step: farther ones seldom are better."""
    before = [node for node in nodes if node <= j][-2:]
    return [*before, *[node for node in nodes if node > j][:1]]


class _Margin(Protocol):
    def __call__(self, i: int, j: int) -> float: ...


def _reach(i: int, count: int, margin: _Margin, margin_db: float) -> int:
    j = i
    while j + 1 < count and margin(i, j + 1) >= margin_db:
        j += 1
    return j


def _steps(route: Sequence[Point]) -> list[tuple[float, Point]]:
    """Places along the route, at most `MAX_STEPS` and at least a meter apart, with their depth; first and last point
    included."""
    length_m = sum(math.dist(a, b) for a, b in pairwise(route))
    count = max(1, min(MAX_STEPS, math.floor(length_m / MIN_STEP_M)))
    found: list[tuple[float, Point]] = []
    start_m, legs = 0.0, list(pairwise(route))
    index = 0
    for number in range(count + 1):
        depth_m = length_m * number / count
        while index < len(legs) - 1 and depth_m > start_m + math.dist(*legs[index]):
            start_m += math.dist(*legs[index])
            index += 1
        (x0, y0), (x1, y1) = legs[index]
        leg_m = math.dist((x0, y0), (x1, y1))
        share = 0.0 if leg_m == 0.0 else min(1.0, (depth_m - start_m) / leg_m)
        found.append((depth_m, (x0 + share * (x1 - x0), y0 + share * (y1 - y0))))
    return found
