"""The inventories that ship with meshctl."""

from __future__ import annotations

from collections import Counter

import pytest

from meshctl.inventory import load_fleet
from meshctl.model import AntennaKind, Fleet, NodeState, Role, TopicClass
from tests.meshctl.inventory.inventories import SHIPPED


@pytest.fixture(scope="module")
def final() -> Fleet:
    return load_fleet(SHIPPED / "subt-final")


def test_the_example_fleet_matches_the_team_in_the_paper(final: Fleet) -> None:
    assert Counter(node.role for node in final.nodes.values()) == {Role.BASE: 1, Role.ROBOT: 7, Role.BEACON: 12}
    assert set(final.robots) == {"base-station", "husky1", "husky2", "spot1", "spot2", "uav1"}
    for husky in ("husky1", "husky2"):
        robot = final.robots[husky]
        assert len(robot.nodes) == 2
        assert len(robot.carries) == 6
        radios = [final.nodes[name].radios[0].hardware for name in robot.nodes]
        assert all(radio.antenna is AntennaKind.SECTOR for radio in radios)
        assert all(final.nodes[name].state is NodeState.CARRIED for name in robot.carries)
    assert all(robot.computer is not None for robot in final.robots.values())


def test_every_radio_stays_within_one_watt_conducted_and_36_dbm(final: Fleet) -> None:
    for node in final.nodes.values():
        for radio in node.radios:
            gain_above_6_dbi = max(0.0, radio.hardware.antenna_gain_dbi - 6)
            assert radio.conducted_dbm <= 30 - gain_above_6_dbi
            assert radio.eirp_dbm <= 36
    beacon = final.nodes["husky1-b01"].radios[0]
    assert (beacon.hardware.rated_power_dbm, beacon.conducted_dbm) == (33, 30)


def test_the_emergency_stop_has_the_highest_priority_and_video_the_lowest(final: Fleet) -> None:
    order = sorted(final.topics, key=lambda topic: topic.priority)
    assert [topic.topic_class for topic in order] == [
        TopicClass.EMERGENCY_STOP,
        TopicClass.COMMAND,
        TopicClass.ARTIFACT,
        TopicClass.TELEMETRY,
        TopicClass.MAP,
        TopicClass.VIDEO,
    ]
    assert len({topic.priority for topic in order}) == len(order)


@pytest.mark.parametrize("name", ["subt-final", "starter"])
def test_addresses_are_unique_and_references_resolve(name: str) -> None:
    fleet = load_fleet(SHIPPED / name)
    addresses = [node.address.ip for node in fleet.nodes.values()]
    addresses += [robot.computer.address.ip for robot in fleet.robots.values() if robot.computer is not None]
    assert len(set(addresses)) == len(addresses)
    network = fleet.meshes["main"].network
    assert all(address in network for address in addresses)
    for robot in fleet.robots.values():
        assert all(node in fleet.nodes for node in (*robot.nodes, *robot.carries))
    for topic in fleet.topics:
        assert all(peer in fleet.robots for peer in topic.sources)
        assert all(peer in fleet.robots for peer in topic.destinations if peer != "all")
    assert fleet.base_node is not None
