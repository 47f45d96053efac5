"""`meshctl status` and `preflight` over robots whose computers, systemd and daemons are real."""

from __future__ import annotations

import json
from typing import Any

from typer.testing import CliRunner

from meshctl.cli.main import build
from tests.meshctl.robots.fleets import RobotFleet


def document(fleet: RobotFleet, *words: str) -> dict[str, Any]:
    """What a command prints as JSON, whatever its exit code."""
    arguments = [*words, "--json", "--timeout", "60", "-i", str(fleet.file)]
    done = CliRunner().invoke(build(words[0]), arguments, catch_exceptions=False)
    value: dict[str, Any] = json.loads(done.stdout)
    return {**value, "exit": done.exit_code}


def serious(robot: dict[str, Any]) -> list[str]:
    """The codes of its warnings and errors; how busy the machine is that the tests run on is a note."""
    return [alarm["code"] for alarm in robot["alarms"] if alarm["level"] != "note"]


def checks(fleet: RobotFleet) -> dict[str, dict[str, Any]]:
    return {check["check"]: check for check in document(fleet, "preflight")["checks"]}


def test_a_deployed_team_is_healthy_and_a_stopped_daemon_is_reported(fleet: RobotFleet) -> None:
    for name in ("alpha", "bravo"):
        fleet.add(name)
    fleet.write()
    before = document(fleet, "status", "--role", "computer")
    assert [serious(robot) for robot in before["robots"]] == [["not-installed"]] * 2
    fleet.deploy()
    team = document(fleet, "status", "--role", "computer")
    assert team["exit"] == 0, team
    alpha = team["robots"][0]
    assert alpha["daemon"]["drift"] == []
    assert [peer["name"] for peer in alpha["peers"] if peer["online"]] == ["bravo"]
    assert [topic["name"] for topic in alpha["topics"]] == ["estop", "status"]
    assert alpha["computer"]["disk_kib"] > 0
    found = checks(fleet)
    names = ("daemons", "one release", "keys", "peers", "urgent topics", "delivery")
    assert {name: found[name]["go"] for name in names} == dict.fromkeys(names, True), found
    assert "all 2 pairs" in found["delivery"]["reason"]
    assert "emergency stop" not in found
    message = fleet.file.with_name("stop.bin")
    message.write_bytes(b"\x01\x00stop")
    stopped = document(fleet, "preflight", "--send-estop", str(message), "--yes")["checks"]
    (stop,) = [check for check in stopped if check["check"] == "emergency stop"]
    assert stop["go"], stop
    assert stop["reason"].startswith("sent, and acknowledged by "), stop
    fleet.meshctl("stop", "bravo")
    after = document(fleet, "status", "--robot", "bravo", "--role", "computer")
    assert (after["exit"], serious(after["robots"][0])) == (1, ["daemon"])
    found = checks(fleet)
    assert not found["delivery"]["go"]
    assert "bravo: its daemon is inactive" in found["daemons"]["reason"]
