"""A mission in virtual time, many times: which robots' reports reach the base, with fading from a seed. Pure.

`run_trial(scenario, seed)`: at every report of a robot, each hop of its route passes or loses the frame by the radio
environment's propagation model, with slow fading that belongs to the place. Routes are chosen every `route_s`, so that
a robot that drives away from its route loses frames until the next choice.

`meshctl lab sweep` compares propagation, placement (when and where beacons are dropped) and intervals with it.
"""

from __future__ import annotations

import heapq
import math
import random
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

from meshctl.placement.path_loss import Point
from meshlab.propagation import received_dbm
from meshlab.scenario import Scenario, Snapshot, snapshot

TRANSMISSIONS = 7
"""Of one unicast frame (802.11's retry limit)."""
_WAVES = 64
"""Of the sum that is the fading field: with more, its distribution is closer to the normal one."""

Losses = dict[tuple[str, str], float]
"""The share of frames lost from one node to another; pairs that hear nothing are absent."""


class FadingField:
    """Slow fading in dB at each place: a sum of waves with random directions, so that it is a function of the place.

    Normal with standard deviation `deviation_db`; the correlation of two places is exp(-d^2 / (2 length_m^2)).
    """

    def __init__(self, rng: random.Random, deviation_db: float, length_m: float) -> None:
        self._scale_db = deviation_db * math.sqrt(2.0 / _WAVES)
        self._waves = [
            (rng.gauss(0.0, 1.0 / length_m), rng.gauss(0.0, 1.0 / length_m), rng.uniform(0.0, 2.0 * math.pi))
            for _ in range(_WAVES)
        ]

    def at(self, place: Point) -> float:
        if not self._scale_db:
            return 0.0
        return self._scale_db * sum(math.cos(x * place[0] + y * place[1] + phase) for x, y, phase in self._waves)


@dataclass(slots=True)
class RobotTotals:
    """The reports received from one robot. `silent_since_s` is when its last report arrived."""

    sent: int = 0
    arrived: int = 0
    hops: int = 0
    silent_since_s: float = 0.0
    longest_gap_s: float = 0.0
    farthest_m: float = 0.0


def run_trial(scenario: Scenario, seed: int) -> dict[str, float | None]:
    """The figures of one mission: for each robot the share of its reports that arrived, its longest gap, the farthest
    place that it reported from and its mean hops; over all robots the share and the longest gap."""
    rng = random.Random(f"mission {seed}")
    trial = scenario.trial
    field = FadingField(rng, trial.shadow_db, trial.shadow_m)
    totals = {name: RobotTotals() for name in scenario.robots}
    routes: dict[str, tuple[str, ...]] = {}
    next_route_s = 0.0
    for number in range(1, int(scenario.duration_s / trial.report_s) + 1):
        now_s = number * trial.report_s
        now = snapshot(scenario, now_s)
        losses = losses_of(now, field)
        if now_s >= next_route_s:
            routes = routes_to(scenario.base, losses)
            next_route_s = now_s + trial.route_s
        base_at = now.environment.positions[scenario.base].at if scenario.base in now.environment.positions else None
        for name, robot in totals.items():
            robot.sent += 1
            if name in now.powered and _arrives(routes.get(name, ()), losses, rng):
                robot.arrived += 1
                robot.hops += len(routes[name]) - 1
                robot.longest_gap_s = max(robot.longest_gap_s, now_s - robot.silent_since_s)
                robot.silent_since_s = now_s
                if base_at is not None:
                    robot.farthest_m = max(robot.farthest_m, math.dist(base_at, now.environment.positions[name].at))
    for robot in totals.values():
        robot.longest_gap_s = max(robot.longest_gap_s, scenario.duration_s - robot.silent_since_s)
    return _figures(totals)


def losses_of(now: Snapshot, field: FadingField) -> Losses:
    """The loss of every link between nodes with power, with the fading of both ends."""
    environment, model = now.environment, now.environment.path_loss
    names = now.powered & environment.positions.keys()
    fading_db = {name: field.at(environment.positions[name].at) for name in names}
    losses: Losses = {}
    for a, b, strengths in received_dbm(environment, names):
        faded_db = (fading_db[a] + fading_db[b]) / math.sqrt(2.0)
        for pair, strength in zip(((a, b), (b, a)), strengths, strict=True):
            loss = model.loss(strength - faded_db)
            if loss < 1.0:
                losses[pair] = loss
    for link in environment.links:
        if link.up and link.ends <= now.powered:
            for pair in ((link.a, link.b), (link.b, link.a)):
                if link.loss_to(pair[1]) < 1.0:
                    losses[pair] = link.loss_to(pair[1])
    return losses


def routes_to(base: str, losses: Mapping[tuple[str, str], float]) -> dict[str, tuple[str, ...]]:
    """Each node's route to the base, both ends included: the fewest expected transmissions, both directions counted."""
    neighbors: dict[str, list[tuple[str, float]]] = {}
    for (a, b), loss in losses.items():
        back = losses.get((b, a), 1.0)
        if back < 1.0:
            neighbors.setdefault(b, []).append((a, 1.0 / ((1.0 - loss) * (1.0 - back))))
    routes: dict[str, tuple[str, ...]] = {}
    queue: list[tuple[float, tuple[str, ...]]] = [(0.0, (base,))]
    while queue:
        cost, route = heapq.heappop(queue)
        if route[0] in routes:
            continue
        routes[route[0]] = route
        for name, transmissions in neighbors.get(route[0], ()):
            if name not in routes:
                heapq.heappush(queue, (cost + transmissions, (name, *route)))
    return routes


def _arrives(route: tuple[str, ...], losses: Mapping[tuple[str, str], float], rng: random.Random) -> bool:
    chance = 1.0 if route else 0.0
    for hop in pairwise(route):
        chance *= 1.0 - losses.get(hop, 1.0) ** TRANSMISSIONS
    # always one number, so that settings with the same seed have the same luck
    return rng.random() < chance


def _figures(totals: Mapping[str, RobotTotals]) -> dict[str, float | None]:
    figures: dict[str, float | None] = {}
    for name, robot in totals.items():
        figures[f"robots.{name}.arrived"] = robot.arrived / robot.sent if robot.sent else None
        figures[f"robots.{name}.longest_gap_s"] = robot.longest_gap_s
        figures[f"robots.{name}.farthest_m"] = robot.farthest_m
        figures[f"robots.{name}.hops"] = robot.hops / robot.arrived if robot.arrived else None
    sent = sum(robot.sent for robot in totals.values())
    figures["arrived"] = sum(robot.arrived for robot in totals.values()) / sent if sent else None
    figures["longest_gap_s"] = max((robot.longest_gap_s for robot in totals.values()), default=None)
    return figures
