"""Missions in virtual time, and `meshctl lab sweep` over them."""

from __future__ import annotations

import json
import random
import statistics
from dataclasses import replace
from pathlib import Path

import pytest

from meshctl.errors import InputError
from meshctl.placement.ground import NodePosition
from meshlab.cli.sweep import study_of, sweep
from meshlab.mission_trial import FadingField, losses_of, routes_to, run_trial
from meshlab.propagation import RadioEnvironment, links_of
from meshlab.scenario import Deployment, PowerEvent, Scenario, Trajectory, TrialSettings, snapshot
from meshlab.spec import LinkSpec

EXAMPLE = Path(__file__).parents[2] / "inventory" / "lab" / "mission.yaml"
INLINE = "tests.mesh_sweep.sample:InlineExecutor"
CALM = TrialSettings(shadow_db=0.0)

# a robot that drives away from the base at 2 m/s with a beacon, which it drops after 100 m
AWAY = Scenario(
    "away",
    "base",
    RadioEnvironment({"base": NodePosition((0, 0), 27.0)}),
    duration_s=200.0,
    robots={"rover": Trajectory((0.0, 200.0), ((0.0, 0.0), (400.0, 0.0)))},
    beacons={"beacon": Deployment("rover", 50.0)},
    trial=CALM,
)


def test_a_seed_gives_the_same_mission_and_another_seed_another_one() -> None:
    faded = replace(AWAY, trial=TrialSettings())
    assert run_trial(faded, 1) == run_trial(faded, 1)
    assert len({str(run_trial(faded, seed)) for seed in range(5)}) > 1


def test_a_beacon_lets_the_robot_report_from_farther_away() -> None:
    with_beacon = run_trial(AWAY, 1)
    without = run_trial(replace(AWAY, beacons={}), 1)
    assert with_beacon["robots.rover.farthest_m"] is not None
    assert without["robots.rover.farthest_m"] is not None
    assert with_beacon["robots.rover.farthest_m"] > without["robots.rover.farthest_m"] + 50
    assert with_beacon["robots.rover.hops"] != without["robots.rover.hops"]


def test_a_robot_without_power_reports_nothing_and_its_gap_lasts_to_the_end() -> None:
    off = replace(AWAY, power_events=(PowerEvent(20.0, "rover", False),))
    found = run_trial(off, 1)
    assert found["robots.rover.arrived"] == pytest.approx(19 / 200)
    assert found["robots.rover.longest_gap_s"] == 181.0


def test_routes_that_are_chosen_seldom_lose_reports() -> None:
    shares = [run_trial(replace(AWAY, trial=replace(CALM, route_s=route_s)), 1)["arrived"] for route_s in (1.0, 60.0)]
    assert shares[0] is not None
    assert shares[1] is not None
    assert shares[0] > shares[1]


def test_without_fading_the_losses_are_those_of_the_links() -> None:
    now = snapshot(replace(AWAY, power_events=()), 120.0)
    environment = replace(now.environment, links=(LinkSpec("base", "rover", loss=0.25, loss_back=0.5),))
    now = replace(now, environment=environment)
    found = losses_of(now, FadingField(random.Random(1), 0.0, 10.0))
    expected: dict[tuple[str, str], float] = {}
    for link in links_of(environment):
        expected |= {(a, b): link.loss_to(b) for a, b in ((link.a, link.b), (link.b, link.a)) if link.loss_to(b) < 1.0}
    assert found == expected
    assert found["base", "rover"] == 0.25


def test_the_route_has_the_fewest_transmissions_and_no_one_way_hop() -> None:
    good, bad = 0.0, 0.8
    losses = {("a", "base"): bad, ("base", "a"): bad, ("a", "b"): good, ("b", "a"): good, ("b", "base"): good,
              ("base", "b"): good, ("c", "base"): good}  # fmt: skip
    assert routes_to("base", losses) == {"base": ("base",), "b": ("b", "base"), "a": ("a", "b", "base")}


def test_fading_has_its_deviation_and_belongs_to_the_place() -> None:
    values, near, far = [], [], []
    for seed in range(300):
        field = FadingField(random.Random(seed), 3.0, 10.0)
        here = field.at((50.0, 20.0))
        assert here == field.at((50.0, 20.0))
        values.append(here)
        near.append(field.at((60.0, 20.0)))
        far.append(field.at((150.0, 20.0)))
    assert statistics.pstdev(values) == pytest.approx(3.0, rel=0.15)
    assert statistics.correlation(values, near) == pytest.approx(0.607, abs=0.12)
    assert abs(statistics.correlation(values, far)) < 0.2


def test_settings_reach_the_mission_and_its_ground(tmp_path: Path) -> None:
    out = tmp_path / "out.jsonl"
    with pytest.raises(BaseException, match="0"):
        sweep(
            EXAMPLE,
            seeds="2",
            settings=["air.exponent=3.5,5", "trial.route_s=5", "beacons.b02.drop_s=80"],
            out=out,
            executor=INLINE,
            as_json=True,
        )
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [(row["set"]["air.exponent"], row["seed"]) for row in rows] == [("3.5", 1), ("3.5", 2), ("5", 1), ("5", 2)]
    assert rows[0]["figures"]["arrived"] > rows[2]["figures"]["arrived"]


@pytest.mark.parametrize(
    ("setting", "problem"),
    [
        ("air.exponnet=4", "ground.yaml:20: air: expected one of tx_power_dbm, antenna_gain_dbi, frequency_mhz, "
         "exponent, sensitivity_dbm, fading_db, model (did you mean 'exponent'?), found 'exponnet' (--set"),
        ("air.exponent=50", "ground.yaml:20: air.exponent: expected a number from 1 to 10, found '50'"),
        ("trial.route_s=0", "mission.yaml:3: trial.route_s: expected a number from 0.1 to 86400, found '0'"),
        ("beacons.b2.drop_s=1", "mission.yaml:11: --set beacons.b2.drop_s=1: beacons: expected one of b01, b02, b03"),
        ("walls[3].loss_db=1", "ground.yaml:17: --set walls[3].loss_db=1: expected walls[0] to walls[2], found 3"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_reported_with_its_file_and_line(setting: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(InputError) as raised:
        sweep(EXAMPLE, settings=[setting], out=tmp_path / "out.jsonl", executor=INLINE)
    assert problem in str(raised.value)


def test_the_ground_is_part_of_the_scenario(tmp_path: Path) -> None:
    for name in ("mission.yaml", "ground.yaml"):
        (tmp_path / name).write_text((EXAMPLE.parent / name).read_text())
    same = study_of(tmp_path / "mission.yaml").identity
    assert same == study_of(EXAMPLE).identity
    ground = tmp_path / "ground.yaml"
    ground.write_text(ground.read_text().replace("exponent: 4.4", "exponent: 4.3"))
    assert study_of(tmp_path / "mission.yaml").identity.scenario_sha256 != same.scenario_sha256
