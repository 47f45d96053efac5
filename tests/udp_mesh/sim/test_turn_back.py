"""A robot explores away from its base: with the example behavior it keeps its link, without it loses it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import pairwise

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.client.turn_back import Need
from udp_mesh.core.conditions import PeerConditions
from udp_mesh.core.link_trend import Direction, Measure, Trend
from udp_mesh.daemon.status import peer_json
from udp_mesh.sim.command import SHIPPED
from udp_mesh.sim.mobility import trajectory
from udp_mesh.sim.run import RunResult, play
from udp_mesh.sim.scenario import ScenarioError, load, parse
from udp_mesh.sim.turning_back import DrivenPath, TurnBack, as_shown

SCENARIO = replace(load(SHIPPED / "turn-back.yaml"), duration_s=300.0)
BEHAVIOR = TurnBack("b", Need(1e6, 9))


@cache
def played(behaves: bool, seed: int) -> RunResult:
    return play(replace(SCENARIO, seed=seed, turn_back=SCENARIO.turn_back if behaves else {}))


def places(result: RunResult) -> list[float]:
    """The robot's distance from the base in meters, once per second."""
    found = [json.loads(line) for line in result.lines]
    return [line["x"] for line in found if line.get("kind") == "place" and line["at"] == "husky"]


def lost(result: RunResult) -> int:
    """How often the robot went offline for the base."""
    return sum(json.loads(line).get("kind") == "peer-offline" for line in result.lines)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_with_the_behavior_the_robot_explores_to_the_edge_and_keeps_its_link(seed: int) -> None:
    result = played(behaves=True, seed=seed)
    assert lost(result) == 0
    # far out, but not to where nothing arrives
    assert SCENARIO.air.good_m < max(places(result)) < SCENARIO.air.range_m
    # out again after it came back
    steps = [later - earlier for earlier, later in pairwise(places(result))]
    turns = [earlier * later < 0 for earlier, later in pairwise(steps)]
    assert sum(turns) >= 3
    # but for what was just sent
    assert result.topics["map"].messages >= result.offered["map"] - 3


@pytest.mark.parametrize("seed", [1, 2])
def test_without_it_the_link_is_lost_for_good(seed: int) -> None:
    result = played(behaves=False, seed=seed)
    assert lost(result) == 1
    assert max(places(result)) > SCENARIO.air.range_m
    assert result.topics["map"].messages < played(behaves=True, seed=seed).topics["map"].messages / 1.5


def known_peer() -> PeerConditions:
    both = pair()
    (found,) = both.a.conditions(both.now).peers
    return replace(
        found,
        available_bits_per_s=(9e6,) * 16,
        trend=Trend(Direction.WORSENING, Measure.CAPACITY, -0.001),
        unanswered_for_s=0.5,
        loss=0.02,
    )


def test_the_simulator_decides_from_what_the_daemon_shows() -> None:
    peer = known_peer()
    shown = peer_json(peer, 0.0)
    assert json.loads(json.dumps(as_shown(peer))) == {key: shown[key] for key in as_shown(peer)}
    assert as_shown(replace(peer, trend=None))["trend"] is None


def test_a_driven_robot_goes_back_the_way_it_came_and_waits_at_its_start() -> None:
    driven = DrivenPath(trajectory([(0.0, (0.0, 0.0)), (100.0, (200.0, 0.0))]), BEHAVIOR)
    assert driven.at(30.0) == (60.0, 0.0)
    # its peer is not known: it is offline
    driven.decide((), 30.0)
    assert driven.at(40.0) == (40.0, 0.0)
    driven.decide((), 40.0)
    assert driven.at(70.0) == (0.0, 0.0)
    good = replace(known_peer(), trend=None)
    driven.decide((good,), 70.0)
    assert driven.at(80.0) == (20.0, 0.0)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ("a: {peer: b}", "turn_back.a: expected the key bits_per_s"),
        ("a: {bits_per_s: 5}", "turn_back.a: expected the key peer"),
        ("a: {peer: a, bits_per_s: 5}", "turn_back.a.peer: expected another robot"),
        ("a: {peer: c, bits_per_s: 5}", "turn_back.a.peer: expected one of a, b, found 'c'"),
        ("a: {peer: b, bits_per_s: 0}", "turn_back.a.bits_per_s: expected a number of at least 1"),
        ("a: {peer: b, bits_per_s: 5, priority: 16}", "turn_back.a.priority: expected a number of at most 15"),
        ("c: {peer: b, bits_per_s: 5}", "turn_back: expected one of a, b"),
    ],
)
def test_a_problem_of_the_behavior_is_reported(entry: str, message: str) -> None:
    text = f"robots: {{a: [0, 0], b: [5, 0]}}\nturn_back: {{{entry}}}\n"
    with pytest.raises(ScenarioError) as raised:
        parse(text.encode(), "s.yaml")
    assert f"s.yaml:2: {message}" in str(raised.value)


def test_priority_and_reserve_have_defaults() -> None:
    scenario = parse(b"robots: {a: [0, 0], b: [5, 0]}\nturn_back: {a: {peer: b, bits_per_s: 1e6}}\n", "s.yaml")
    assert scenario.turn_back == {"a": BEHAVIOR}
