"""The status of robots: health, alarms, topics and peers."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Interface
from types import MappingProxyType
from typing import Any

import pytest

from meshctl.errors import ExitCode
from meshctl.fleet.journal import LastKnown
from meshctl.model import Computer, Fleet
from meshctl.robots.facts import ComputerFacts, RobotFacts, ServiceFacts, TopicFacts
from meshctl.status import Health, Level
from meshctl.status.json_output import as_json
from meshctl.status.last_known import facts_to_record, merge_by_device
from meshctl.status.text import text
from meshctl.status.topics import limit_s
from meshctl.status.values import NoAnswer
from tests.meshctl.status.fleets import NOW, TEAM, alarms, peer, queue, robot_facts, robot_health, status_of

DOWN = NoAnswer("no answer to connect within 5 s")
COMPUTER = TEAM["rover"].computer


def with_rover(**change: Any) -> dict[str, RobotFacts]:
    return {**TEAM, "rover": replace(TEAM["rover"], **change)}


def test_a_healthy_team_is_ok_and_a_shelved_robot_is_off(fleet: Fleet) -> None:
    status = status_of(fleet, silent_robots={"shelf": DOWN})
    assert robot_health(status) == {"station": Health.OK, "rover": Health.OK, "shelf": Health.OFF}
    assert status.exit_code is ExitCode.OK


def test_an_unreachable_robot_heard_by_its_peers_is_reported_as_such(fleet: Fleet) -> None:
    status = status_of(fleet, robots={"station": TEAM["station"]}, silent_robots={"rover": DOWN})
    assert robot_health(status)["rover"] is Health.UNREACHABLE
    assert (
        "station hears it (0.5 s ago): its daemon is heard" in alarms(status, "rover", robot=True)["unreachable"].text
    )
    assert status.exit_code is ExitCode.UNREACHABLE


def test_an_unpinned_computer_is_reported_with_the_command_that_pins_it(fleet: Fleet) -> None:
    silent = {"rover": NoAnswer("no key is pinned", "untrusted")}
    status = status_of(fleet, robots={"station": robot_facts("station")}, silent_robots=silent)
    assert "meshctl robots trust rover" in alarms(status, "rover", robot=True)["untrusted"].hint


@pytest.mark.parametrize(
    ("change", "code", "level"),
    [
        ({"service": ServiceFacts("failed", "enabled", 3, "exit-code")}, "daemon", Level.ERROR),
        ({"service": ServiceFacts(), "release": ""}, "not-installed", Level.ERROR),
        ({"status": {}}, "daemon", Level.ERROR),
        ({"is_proven": False}, "unproven", Level.WARNING),
        ({"bridge": ServiceFacts("failed", "enabled")}, "ros-bridge", Level.ERROR),
        ({"drift": ("differs from the inventory: etc/udp-mesh.toml",)}, "drift", Level.WARNING),
        ({"version": "0.0.9"}, "version", Level.WARNING),
        ({"keys": ("cc", "bb")}, "key", Level.ERROR),
        ({"unkeyed": True}, "unkeyed", Level.NOTE),
        ({"peers": (peer("station", online=False),)}, "peers", Level.ERROR),
        ({"queues": (queue(0, 2, 7.0),)}, "urgent-queue", Level.WARNING),
        ({"computer": replace(COMPUTER, disk_free_kib=1 << 10)}, "disk", Level.ERROR),
        ({"computer": replace(COMPUTER, disk_free_kib=1 << 20)}, "disk", Level.WARNING),
        ({"computer": replace(COMPUTER, memory_free_kib=1 << 10)}, "memory", Level.WARNING),
        ({"computer": replace(COMPUTER, clock_ahead_s=-3600.0)}, "clock", Level.WARNING),
        ({"computer": replace(COMPUTER, load=(40.0, 9.0, 3.0))}, "load", Level.NOTE),
    ],
)
def test_each_robot_problem_has_an_alarm_code_and_level(
    fleet: Fleet, change: dict[str, Any], code: str, level: Level
) -> None:
    status = status_of(fleet, robots=with_rover(**change))
    alarm = alarms(status, "rover", robot=True)[code]
    assert alarm.level is level
    is_degraded = robot_health(status)["rover"] is Health.DEGRADED
    assert is_degraded == (level > Level.NOTE)


@pytest.mark.parametrize(
    "change",
    [
        {"queues": (queue(6, 500, 60.0), queue(0, 1, 0.1))},
        {"computer": ComputerFacts()},
        {"computer": replace(COMPUTER, clock_ahead_s=2.0)},
    ],
)
def test_normal_or_unreported_values_raise_no_alarm(fleet: Fleet, change: dict[str, Any]) -> None:
    assert alarms(status_of(fleet, robots=with_rover(**change)), "rover", robot=True) == {}


def test_the_most_common_version_is_the_expected_one(fleet: Fleet) -> None:
    team = {
        name: robot_facts(name, version=version) for name, version in (("station", "2"), ("rover", "2"), ("shelf", "1"))
    }
    status = status_of(fleet, robots=team)
    assert "version" not in alarms(status, "rover", robot=True)
    assert "most others 2" in alarms(status, "shelf", robot=True)["version"].text


def test_peers_do_not_report_a_robot_that_is_off(fleet: Fleet) -> None:
    status = status_of(fleet, robots={"station": robot_facts("station")}, silent_robots={"rover": DOWN})
    assert "peers" not in alarms(status, "station", robot=True)


def test_an_urgent_queue_that_grows_since_the_last_look_is_an_error(fleet: Fleet) -> None:
    first = status_of(fleet, robots=with_rover(queues=(queue(0, 2, 7.0, 1000),)))
    known = merge_by_device({name: LastKnown(name, NOW - 5, facts) for name, facts in facts_to_record(first).items()})
    second = status_of(fleet, robots=with_rover(queues=(queue(0, 4, 12.0, 2500),)), known=known)
    alarm = alarms(second, "rover", robot=True)["urgent-queue"]
    assert (alarm.level, "1000 to 2500 B" in alarm.text) == (Level.ERROR, True)
    drained = status_of(fleet, robots=with_rover(queues=(queue(0, 1, 12.0, 500),)), known=known)
    assert alarms(drained, "rover", robot=True)["urgent-queue"].level is Level.WARNING


def test_restarts_count_since_the_last_look(fleet: Fleet) -> None:
    known = {"robot.rover": LastKnown("robot.rover", NOW - 60, {"restarts": "2"})}
    status = status_of(fleet, robots=with_rover(service=ServiceFacts("active", "enabled", 5)), known=known)
    assert "3 times since the last snapshot" in alarms(status, "rover", robot=True)["restarts"].text


def topics(robot: str, **change: TopicFacts) -> dict[str, RobotFacts]:
    """The team, with one robot's topics changed by name."""
    mine = tuple(change.get(topic.name, topic) for topic in TEAM[robot].topics if topic.name not in change)
    return {**TEAM, robot: replace(TEAM[robot], topics=(*mine, *change.values()))}


def test_the_silence_limit_of_a_topic_depends_on_its_rate_and_deadline(fleet: Fleet) -> None:
    limits = {topic.name: limit_s(topic) for topic in fleet.topics}
    assert limits == {"estop": 50.0, "commands": None, "telemetry": 10.0}


def test_a_topic_not_sent_for_too_long_is_reported_as_silent(fleet: Fleet) -> None:
    team = topics("rover", telemetry=TopicFacts("telemetry", 3, 10, 10, 40.0, 0.3))
    alarm = alarms(status_of(fleet, robots=team), "rover", robot=True)["topic-silent"]
    assert alarm.text == "telemetry: nothing sent for 40 s"


def test_a_topic_that_does_not_arrive_is_reported_with_its_senders(fleet: Fleet) -> None:
    team = topics("rover", estop=TopicFacts("estop", 0, 0, 10, None, 90.0))
    alarm = alarms(status_of(fleet, robots=team), "rover", robot=True)["topic-not-arriving"]
    assert (alarm.level, alarm.text) == (Level.ERROR, "estop: nothing received for 90 s, although station sends")


def test_receivers_are_not_reported_while_the_source_is_silent(fleet: Fleet) -> None:
    team = topics("station", estop=TopicFacts("estop", 0, 10, 0, 300.0, None))
    team = {**team, "rover": topics("rover", estop=TopicFacts("estop", 0, 0, 10, None, 300.0))["rover"]}
    status = status_of(fleet, robots=team)
    assert "topic-silent" in alarms(status, "station", robot=True)
    assert alarms(status, "rover", robot=True) == {}


def test_a_recently_started_daemon_is_not_yet_silent(fleet: Fleet) -> None:
    team = with_rover(
        daemon_uptime_s=4.0, topics=(TopicFacts("estop", 0), TopicFacts("commands", 1), TopicFacts("telemetry", 3))
    )
    assert alarms(status_of(fleet, robots=team), "rover", robot=True) == {}


def test_an_urgent_topic_missing_from_a_daemon_is_an_error(fleet: Fleet) -> None:
    team = with_rover(topics=TEAM["rover"].topics[1:])
    assert alarms(status_of(fleet, robots=team), "rover", robot=True)["topic-undeclared"].level is Level.ERROR
    other = topics("rover", telemetry=TopicFacts("telemetry", 7, 10, 10, 0.1, 0.1))
    alarm = alarms(status_of(fleet, robots=other), "rover", robot=True)["topic-undeclared"]
    assert (alarm.level, alarm.text) == (Level.WARNING, "telemetry: expected priority 3, found 7")


def test_a_computer_is_listed_below_its_radio(fleet: Fleet) -> None:
    rows = [line.split()[:2] for line in text(status_of(fleet)).splitlines() if line.startswith(("rover", "station"))]
    assert rows == [["station", "computer"], ["rover", "robot"], ["rover", "computer"]]


def with_others(fleet: Fleet) -> Fleet:
    others = {
        "jetson": Computer(IPv4Interface("10.42.0.31/24")),
        "lidar": Computer(IPv4Interface("10.42.0.32/24")),
    }
    rover = replace(fleet.robots["rover"], computers=MappingProxyType(others))
    return replace(fleet, robots=MappingProxyType({**fleet.robots, "rover": rover}))


def test_another_computer_that_does_not_answer_a_ping_is_reported_by_name(fleet: Fleet) -> None:
    status = status_of(with_others(fleet), robots=with_rover(answering=("10.42.0.31",)))
    found = alarms(status, "rover", robot=True)
    assert found["computer-silent"].text == "its computer lidar (10.42.0.32) does not answer a ping"
    (rover,) = (robot for robot in as_json(status)["robots"] if robot["name"] == "rover")
    assert rover["computers"] == [
        {"name": "jetson", "address": "10.42.0.31", "answers": True},
        {"name": "lidar", "address": "10.42.0.32", "answers": False},
    ]


def test_a_robot_without_ping_says_nothing_about_its_other_computers(fleet: Fleet) -> None:
    status = status_of(with_others(fleet), robots=with_rover(answering=None))
    assert "computer-silent" not in alarms(status, "rover", robot=True)
    (rover,) = (robot for robot in as_json(status)["robots"] if robot["name"] == "rover")
    assert [one["answers"] for one in rover["computers"]] == [None, None]
