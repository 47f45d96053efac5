"""What commands do on one robot: by the command's name, with what the journal keeps to do it again.

`begin` runs a command on a crew; `take_up` does so for the robots that an earlier run left (`meshctl resume`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from meshctl.cli.context import Session
from meshctl.cli.output import echo
from meshctl.cli.robots_context import Crew, Work, crew_in, end, sudo_password
from meshctl.errors import InputError
from meshctl.fleet import Outcome, Result
from meshctl.fleet.journal import RunRecord
from meshctl.robots.deploy import claimed, deploy, roll_back
from meshctl.robots.host import Host

# systemd stops and starts two services (TimeoutStopSec, TimeoutStartSec of the units).
SERVICE_TIMEOUT_S = 240.0
PREFIX = "robots "

Told = Mapping[str, Any]


def begin(crew: Crew, command: str, **told: Any) -> dict[str, Outcome]:
    """Carry a command out on all robots of the crew; `told` is what it needs besides, and goes into the journal."""
    told = {**told, "wait_s": crew.order.wait_s, "wheels": str(crew.wheels.resolve()) if crew.wheels else ""}
    return crew.change(command, lambda opened: _work(command, opened, told), told)


def _work(command: str, crew: Crew, told: Told) -> Work:
    match command:
        # topics and keys are changed in the inventory first; what is left for a robot is its deploy
        case "deploy" | "topic" | "rotate-key":
            return lambda host, robot: deploy(host, robot, crew.order)
        case "rollback":
            return lambda host, robot: roll_back(host, robot, crew.order)
        case "restart" | "stop":
            return lambda host, robot: _service(host, robot, command)
        case "uninstall":
            return lambda host, robot: _remove(host, robot, purge=bool(told.get("purge")))
        case _:
            raise InputError(f"a run of `robots {command}` cannot be taken up", hint="run the command again")


def _service(host: Host, robot: str, verb: str) -> Outcome:
    with claimed(host):
        states = host.run("service", verb, timeout_s=SERVICE_TIMEOUT_S).splitlines()
    told = [f"the {'ROS bridge' if 'ros' in unit else 'service'} is {state}" for unit, state in map(str.split, states)]
    return Outcome(robot, Result.DONE, ", ".join(told))


def _remove(host: Host, robot: str, *, purge: bool) -> Outcome:
    with claimed(host):
        host.run("remove", "purge" if purge else "keep", timeout_s=SERVICE_TIMEOUT_S)
    return Outcome(robot, Result.DONE, "removed")


def take_up(opened: Session, inventory: Path, record: RunRecord, *, as_json: bool) -> typer.Exit:
    """Do an earlier run's command for the robots that it left; the exit to raise."""
    command = record.command.removeprefix(PREFIX)
    told = json.loads(record.plan).get("robots", {}) if record.plan else {}
    able = {name for name, robot in opened.fleet.robots.items() if robot.computer is not None}
    names = [name for name in opened.journal.unfinished(record.id) if name in able]
    if not names:
        echo(f"run {record.id} left nothing to do")
        return typer.Exit()
    if command == "rotate-key":
        # its steps need all robots, and the inventory knows which is next
        again = f"meshctl robots rotate-key {told.get('new_key', 'NEW_KEY')}"
        raise InputError(f"run {record.id} changed keys in steps over all robots", hint=f"go on with `{again}`")
    if not as_json:
        echo(f"resuming run {record.id} ({record.command}): {', '.join(names)}")
    wheels, wait_s = told.get("wheels", ""), int(told.get("wait_s", 30))
    crew = crew_in(
        opened,
        inventory,
        names,
        sudo_password(False),
        wheels=Path(wheels) if wheels else None,
        wait_s=wait_s,
        as_json=as_json,
    )
    crew = crew.at(opened.fleet, only_configuration=command == "topic")
    return end(crew, begin(crew, command, **told))
