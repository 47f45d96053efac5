"""Alarms of thin links come from the status that a real daemon gives."""

from __future__ import annotations

from dataclasses import replace

import pytest

from meshctl.robots.facts import RobotFacts
from meshctl.status.alarm_codes import CODES
from meshctl.status.thin_alarms import only_thin, thin_alarms
from tests.udp_mesh.core.thin.fleet import ThinFleet
from udp_mesh.core.thin.conditions import ThinConditions
from udp_mesh.daemon.status import thin_json


@pytest.fixture(scope="module")
def conditions() -> ThinConditions:
    fleet = ThinFleet("base", "husky1")
    assert fleet.run(600, fleet.met)
    return fleet.conditions("base")


def facts(conditions: ThinConditions | None, **failures: str) -> RobotFacts:
    return RobotFacts("base", status={"version": "1", "thin": thin_json(conditions, failures, failures)})


def test_a_robot_that_is_reached_only_there_is_named(conditions: ThinConditions) -> None:
    assert only_thin(facts(conditions)) == ("husky1",)
    [alarm] = thin_alarms(facts(conditions))
    assert (alarm.code, alarm.text) == ("thin-only", "reaches husky1 by thin links only")


def test_each_fault_is_an_alarm(conditions: ThinConditions) -> None:
    [link], [peer] = conditions.links, conditions.peers
    wrong = replace(
        conditions,
        links=(replace(link, rejecting_s=10.0, waits_for_budget_s=3.0),),
        peers=(replace(peer, only_thin=False, conflicting_name="spot"),),
        own_number_used_by="uav",
    )
    found = list(thin_alarms(facts(wrong, lora="/dev/ttyUSB0: No such file or directory")))
    assert [alarm.code for alarm in found] == ["thin-link"] * 3 + ["thin-airtime", "thin-link", "thin-link"]
    assert all(alarm.code in CODES and alarm.hint for alarm in found)


@pytest.mark.parametrize(
    "status", [{}, {"thin": None}, {"thin": 3}, {"thin": {"links": 3, "peers": [7], "failures": []}}]
)
def test_a_daemon_without_thin_links_or_with_nonsense_has_none(status: dict[str, object]) -> None:
    assert list(thin_alarms(RobotFacts("base", status=status))) == []
