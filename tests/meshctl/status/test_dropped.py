"""A carried beacon that is away from its robot has been dropped."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import pytest

from meshctl.cli.deployed_watch import TwoSnapshots
from meshctl.model import Fleet, NodeState
from meshctl.status.dropped import dropped_beacons
from meshctl.status.values import Health, Level, Neighbor, NodeStatus
from tests.meshctl.status.fleets import HEALTHY, alarms, seen, status_of


def judged(fleet: Fleet, *, rover: Health = Health.OK, b02: Health = Health.OK, **facts: object) -> dict[str, str]:
    """The dropped beacons when rover carries b02, with these facts of b02."""
    robots = {**fleet.robots, "rover": replace(fleet.robots["rover"], carries=("b02",))}
    changed: list[NodeStatus] = []
    for node in status_of(fleet).nodes:
        if node.name == "b02":
            node = replace(node, **{"relays": (), "neighbors": (), "health": b02, **facts})  # type: ignore[arg-type]
        changed.append(replace(node, health=rover) if node.name == "rover" else node)
    return dropped_beacons(replace(fleet, robots=robots), changed)


def heard(**signals: int | None) -> tuple[Neighbor, ...]:
    return tuple(Neighbor(name, 100, None, signal) for name, signal in signals.items())


def test_a_beacon_that_relays_has_been_dropped(fleet: Fleet) -> None:
    assert judged(fleet, relays=("b01",)) == {"b02": "relays to the base for b01"}


@pytest.mark.parametrize("signal", [-60, -35])
def test_a_relay_that_its_robot_hears_strongly_is_on_in_the_rack(signal: int, fleet: Fleet) -> None:
    assert judged(fleet, relays=("b01",), neighbors=heard(b01=-70, rover=signal)) == {}


@pytest.mark.parametrize("neighbors", [heard(rover=-61), heard(rover=None), heard(b01=-70)])
def test_a_relay_that_its_robot_does_not_hear_strongly_has_been_dropped(
    neighbors: tuple[Neighbor, ...], fleet: Fleet
) -> None:
    assert judged(fleet, relays=("b01",), neighbors=neighbors) == {"b02": "relays to the base for b01"}


def test_status_does_not_note_a_relay_of_its_own_robot_alone(fleet: Fleet) -> None:
    """Side by side, a robot's best path often leads through its own rack."""
    through = {
        "base": seen("base", {"b02": 250}),
        "b02": seen("b02", {"base": 250, "rover": 250}),
        "rover": seen("rover", {"b02": 250}),
    }
    (stray,) = (node.relays for node in status_of(fleet, through).nodes if node.name == "b02")
    assert stray == ("rover",)
    rover = replace(fleet.robots["rover"], carries=("b02",))
    team = replace(fleet, robots=MappingProxyType({**fleet.robots, "rover": rover}))
    (aboard,) = (node.relays for node in status_of(team, through).nodes if node.name == "b02")
    assert aboard == ()
    assert "dropped" not in alarms(status_of(team, through), "b02")
    deployed = replace(fleet.nodes["b02"], state=NodeState.DEPLOYED)
    after = replace(team, nodes=MappingProxyType({**team.nodes, "b02": deployed}))
    (relays,) = (node.relays for node in status_of(after, through).nodes if node.name == "b02")
    assert relays == ("rover",)


def test_a_beacon_that_its_robot_does_not_hear_has_been_dropped(fleet: Fleet) -> None:
    assert judged(fleet, neighbors=heard(b01=-55)) == {"b02": "hears b01, not its robot's rover"}
    assert judged(fleet, neighbors=heard(b01=-55, rover=-71)) == {"b02": "hears its robot's rover with -71 dBm only"}


@pytest.mark.parametrize("neighbors", [heard(rover=-35), heard(rover=-35, b01=-70), heard(rover=None), ()])
def test_a_beacon_still_in_the_rack_has_not_been_dropped(fleet: Fleet, neighbors: tuple[Neighbor, ...]) -> None:
    assert judged(fleet, neighbors=neighbors) == {}


def test_without_an_answer_from_robot_and_beacon_nothing_is_inferred(fleet: Fleet) -> None:
    assert judged(fleet, neighbors=heard(b01=-55), rover=Health.UNREACHABLE) == {}
    assert judged(fleet, neighbors=heard(b01=-55), b02=Health.OFF) == {}


def test_only_carried_beacons_are_judged(fleet: Fleet) -> None:
    b02 = fleet.nodes["b02"]
    assert b02.state is NodeState.CARRIED
    deployed = replace(b02, state=NodeState.DEPLOYED)
    assert judged(fleet, node=deployed, relays=("b01",)) == {}


def test_status_notes_a_beacon_that_is_away_from_its_robot_and_how_to_mark_it(fleet: Fleet) -> None:
    rover = replace(fleet.robots["rover"], carries=("b02",))
    team = replace(fleet, robots=MappingProxyType({**fleet.robots, "rover": rover}))
    away = {**HEALTHY, "b02": seen("b02", {"b01": 250})}
    note = alarms(status_of(team, away), "b02")["dropped"]
    assert (note.level, note.text) == (Level.NOTE, "marked as carried, but hears b01, not its robot's rover")
    assert "meshctl deployed b02" in note.hint
    in_rack = {**HEALTHY, "b02": seen("b02", {"b01": 120, "rover": 60})}
    # the fixture's stations are heard with -60 dBm, the weakest signal in a rack
    assert "dropped" not in alarms(status_of(team, in_rack), "b02")


def test_a_drop_is_confirmed_by_two_snapshots_in_a_row() -> None:
    snapshots = TwoSnapshots()
    assert snapshots.confirmed({"b01": "weak"}) == {}
    assert snapshots.confirmed({"b01": "weak", "b02": "far"}) == {"b01": "weak"}
    # b02 was back in the rack meanwhile
    assert snapshots.confirmed({}) == {}
    assert snapshots.confirmed({"b02": "far"}) == {}
    assert snapshots.confirmed({"b02": "gone"}) == {"b02": "gone"}
