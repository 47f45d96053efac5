"""A carried beacon that is away from its robot has been dropped."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.model import Fleet, NodeState
from meshctl.status.dropped import dropped_beacons
from meshctl.status.values import Health, Neighbor, NodeStatus
from tests.meshctl.status.fleets import status_of


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
