"""Seeded tunnels: a bent drift with walls, junctions, and slow fading that belongs to the place. Deterministic."""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import accumulate, pairwise

from meshctl.placement.path_loss import PathLossModel, Point, RadioModel, SubtModel, Wall, walls_between

LENGTH_M = 2500.0
HALF_WIDTH_M = 2.5
SHADOW_DB = 3.0
SHADOW_LENGTH_M = 10.0
"""Distance after which slow fading has decorrelated to 1/e (Gudmundson's model)."""
HOPELESS_DB = 20.0
MODELS = ("lab", "subt")


@dataclass(frozen=True)
class Tunnel:
    """A route of straight drifts from the base at 0 m; `junctions_m` are where side drifts leave it."""

    seed: int
    points: tuple[Point, ...]
    walls: tuple[Wall, ...]
    junctions_m: tuple[float, ...]
    air: RadioModel
    shadows_db: tuple[float, ...]
    """Slow fading for each meter of the route."""

    @cached_property
    def _corners_m(self) -> tuple[float, ...]:
        return (0.0, *accumulate(math.dist(a, b) for a, b in pairwise(self.points)))

    @property
    def length_m(self) -> float:
        return self._corners_m[-1]

    def at(self, depth_m: float) -> Point:
        """The place at this depth of the route."""
        leg = min(max(bisect_right(self._corners_m, depth_m) - 1, 0), len(self.points) - 2)
        (x0, y0), (x1, y1) = self.points[leg], self.points[leg + 1]
        share = (depth_m - self._corners_m[leg]) / (self._corners_m[leg + 1] - self._corners_m[leg])
        return (x0 + share * (x1 - x0), y0 + share * (y1 - y0))

    def heading(self, depth_m: float) -> float:
        leg = min(max(bisect_right(self._corners_m, depth_m) - 1, 0), len(self.points) - 2)
        (x0, y0), (x1, y1) = self.points[leg], self.points[leg + 1]
        return math.atan2(y1 - y0, x1 - x0)

    def power_dbm(self, a_m: float, b_m: float) -> float:
        """The slowly varying received power between two depths."""
        low, high = sorted((round(a_m), round(b_m)))
        return self._power(low, high)

    @cached_property
    def _powers(self) -> dict[tuple[int, int], float]:
        return {}

    def _power(self, low: int, high: int) -> float:
        found = self._powers.get((low, high))
        if found is None:
            a, b = self.at(low), self.at(high)
            distance_m, tx_dbm = math.dist(a, b), self.air.tx_power_dbm
            found = self.air.power_dbm(distance_m, tx_dbm, ())
            # what even a straight drift would not carry needs no search for walls
            if found > self.air.noise_dbm - HOPELESS_DB:
                found = self.air.power_dbm(distance_m, tx_dbm, walls_between(self.walls, a, b))
            found -= (self.shadows_db[low] + self.shadows_db[high]) / math.sqrt(2)
            self._powers[low, high] = found
        return found


@lru_cache(maxsize=8)
def tunnel(model: str, seed: int) -> Tunnel:
    """Tunnel `seed`: the same course for both models; rock and air differ from mine to mine."""
    rng = random.Random(f"tunnel-{seed}")
    points: list[Point] = [(0.0, 0.0)]
    heading, depth_m = 0.0, 0.0
    junctions = []
    while depth_m < LENGTH_M:
        leg_m = rng.uniform(25.0, 150.0)
        points.append((points[-1][0] + leg_m * math.cos(heading), points[-1][1] + leg_m * math.sin(heading)))
        depth_m += leg_m
        # mines wander: the general direction stays, so that the drift does not cross itself
        turn = math.radians(rng.uniform(15.0, 90.0)) * rng.choice((-1, 1))
        heading = max(-1.4, min(1.4, heading + turn))
        if rng.random() < 0.5:
            junctions.append(depth_m - rng.uniform(0.0, 0.5) * leg_m)
    loss_db = rng.uniform(8.0, 20.0)
    exponent = rng.uniform(2.0, 3.5)
    cost = rng.uniform(1.0, 3.0)
    walls = tuple(replace(wall, loss_db=loss_db, visibility_cost=cost) for wall in _walls(points))
    air: RadioModel = PathLossModel(exponent=exponent) if model == "lab" else SubtModel()
    return Tunnel(seed, tuple(points), walls, tuple(junctions), air, _shadows(rng, math.ceil(depth_m) + 1))


def _walls(points: list[Point]) -> list[Wall]:
    """Both sides of the drift, mitred at its bends."""
    sides: list[list[Point]] = [[], []]
    for index, point in enumerate(points):
        before, after = points[max(index - 1, 0)], points[min(index + 1, len(points) - 1)]
        into = math.atan2(point[1] - before[1], point[0] - before[0]) if index else None
        out = math.atan2(after[1] - point[1], after[0] - point[0]) if index < len(points) - 1 else None
        first, second = into if into is not None else out, out if out is not None else into
        assert first is not None
        assert second is not None
        half = (second - first) / 2
        normal, reach = first + half + math.pi / 2, HALF_WIDTH_M / max(0.3, math.cos(half))
        for side, sign in zip(sides, (1, -1), strict=True):
            side.append((point[0] + sign * reach * math.cos(normal), point[1] + sign * reach * math.sin(normal)))
    return [Wall(a, b) for side in sides for a, b in pairwise(side)]


def _shadows(rng: random.Random, count: int) -> tuple[float, ...]:
    keep = math.exp(-1.0 / SHADOW_LENGTH_M)
    values = [rng.gauss(0.0, SHADOW_DB)]
    for _ in range(count):
        values.append(keep * values[-1] + math.sqrt(1 - keep * keep) * rng.gauss(0.0, SHADOW_DB))
    return tuple(values)
