"""The laws of the placement benchmark, and a small part of the comparison."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Callable

import pytest

from benchmarks.placement.__main__ import RESULTS, measure
from benchmarks.placement.drive import Second, drive, reach_m
from benchmarks.placement.rules import Bobcat, ByMeter, Ladder, Rule, View
from benchmarks.placement.tunnels import MODELS, Tunnel, tunnel
from meshctl.placement.path_loss import PathLossModel, Point


def view(
    at: Point,
    *,
    now_s: float = 0.0,
    heard: bool = True,
    heading: float = 0.0,
    relays: dict[int, Point] | None = None,
    rssi: dict[int, float] | None = None,
    junction: bool = False,
) -> View:
    places = relays or {0: (0.0, 0.0)}
    return View(now_s, at, heading, heard, rssi or {}, places, {}, junction, 5, -95.0, 7.0)


def dropped(rule: Bobcat, depths: range, **given: object) -> list[int]:
    """The seconds at which the rule drops on a straight drive; its own drops become relays."""
    relays: dict[int, Point] = {0: (0.0, 0.0)}
    found = []
    for second, depth in enumerate(depths):
        junction = depth == given.get("junction")
        heading = 1.0 if depth >= float(str(given.get("bend", math.inf))) else 0.0
        step = rule.step(view((depth, 0.0), now_s=second, heading=heading, relays=dict(relays), junction=junction))
        if step.drop:
            relays[len(relays)] = (depth, 0.0)
            found.append(depth)
    return found


def test_bobcats_rule_drops_by_distance_at_junctions_and_in_bends() -> None:
    assert dropped(Bobcat(100, 30), range(1, 200)) == [101, 132, 163, 194]
    assert dropped(Bobcat(200, 200), range(1, 300)) == [201]
    assert dropped(Bobcat(200, 200), range(1, 190), junction=60) == [60]
    # four seconds before and after: the turn is seen some meters on
    (bend,) = dropped(Bobcat(200, 200), range(1, 190), bend=60)
    assert 60 <= bend <= 66
    # never below ten meters from the anchor
    assert dropped(Bobcat(100, 30), range(1, 9), junction=5) == []


def test_bobcats_rule_drives_back_when_it_is_out_of_reach_and_drops_where_it_is_heard_again() -> None:
    rule = Bobcat(200, 200)
    moves = [rule.step(view((float(100 + s), 0.0), now_s=s, heard=s < 5)).move for s in range(30)]
    assert moves.index(-1) >= 15
    back = [rule.step(view((float(110 - s), 0.0), now_s=30 + s, heard=s > 5)) for s in range(20)]
    assert [step.drop for step in back].count(True) == 1


def test_the_ladder_drops_once_per_step_of_the_signal_to_the_base() -> None:
    rule = Ladder()
    drops = [rule.step(view((1.0, 0.0), rssi={0: float(dbm)})).drop for dbm in range(-50, -72, -1)]
    assert [-50 - index for index, drop in enumerate(drops) if drop] == [-55, -60, -65, -70]


def test_the_outage_is_counted_up_to_each_place() -> None:
    run = [Second(float(depth), depth not in (5, 6, 30), 0) for depth in range(1, 41)]
    assert reach_m(run, 0.0) == 4.0
    assert reach_m(run, 0.05) == 0.0 + 4.0
    assert reach_m(run, 0.1) == 40.0


def test_a_tunnel_is_the_same_every_time_and_its_bends_cost_signal() -> None:
    first, again = tunnel.__wrapped__("lab", 3), tunnel.__wrapped__("lab", 3)
    assert (first.points, first.walls, first.shadows_db) == (again.points, again.walls, again.shadows_db)
    assert tunnel("subt", 3).points == first.points
    corner = math.dist(first.points[0], first.points[1])
    straight = _mean_loss(first, corner - 15.0, corner - 5.0)
    around = _mean_loss(first, corner + 8.0, corner + 18.0)
    assert isinstance(first.air, PathLossModel)
    assert around - straight > first.walls[0].loss_db


def _mean_loss(ground: Tunnel, from_m: float, to_m: float) -> float:
    return -statistics.mean(ground.power_dbm(1.0, depth) for depth in range(round(from_m), round(to_m)))


@pytest.mark.parametrize("model", MODELS)
def test_the_meter_reaches_farther_than_the_rules_at_equal_outage(model: str) -> None:
    rules: dict[str, Callable[[], Rule]] = {
        "meter": ByMeter,
        "200/200": lambda: Bobcat(200, 200),
        "100/30": lambda: Bobcat(100, 30),
        "ladder": Ladder,
    }
    reached: dict[str, list[float]] = {name: [] for name in rules}
    for seed in range(12):
        for name, make in rules.items():
            reached[name].append(reach_m(drive(tunnel(model, seed), make(), 4, seed), 0.05))
    medians = {name: statistics.median(values) for name, values in reached.items()}
    assert all(medians["meter"] > medians[name] for name in rules if name != "meter"), medians


def test_the_published_results_are_those_of_this_code() -> None:
    rows = [json.loads(line) for line in RESULTS.read_text().splitlines()]
    kept = next(row for row in rows if (row["model"], row["seed"], row["beacons"]) == ("lab", 1, 3))
    assert measure("lab", 1, 3) == kept
    assert {(row["model"], row["seed"]) for row in rows} >= {(model, seed) for model in MODELS for seed in range(50)}
