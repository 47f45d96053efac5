"""`meshctl preflight`: one look, urgent messages between all robots, and go or no-go."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence

import typer

from meshctl.cli.fleet_view import Everybody, glance, paint_of, with_everybody
from meshctl.cli.options import AsJson, line_width
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode
from meshctl.status import Check, assess
from meshctl.status import preflight as checks_of
from meshctl.status.json_output import preflight_json
from meshctl.status.last_known import facts_to_keep
from meshctl.status.robots import takes_part
from meshctl.status.text import preflight_text


@with_everybody
def preflight(everybody: Everybody, as_json: AsJson = False) -> None:
    """Go or no-go for the run: one line per check, with the reason. Urgent messages are really sent between all robots.

    Exit code: 0 go, 1 no-go, 2 could not look.

    Example: meshctl preflight
    """
    found = assess(glance(everybody), everybody.nodes, time.time(), everybody.robots)
    everybody.opened.journal.remember_all(everybody.fleet.name, facts_to_keep(found), time.time())
    talking = [
        robot.name
        for robot in found.robots
        if takes_part(robot.state) and robot.facts is not None and robot.facts.answers
    ]
    checks = checks_of(everybody.fleet, found, everybody.watcher.ping(talking))
    show(checks, as_json=as_json)
    raise typer.Exit(ExitCode.OK if all(check.is_go for check in checks) else ExitCode.FINDINGS)


def show(checks: Sequence[Check], *, as_json: bool) -> None:
    """Print the checks and the verdict."""
    if as_json:
        echo_json(json.dumps(preflight_json(checks), indent=2))
    else:
        echo(preflight_text(checks, line_width(), paint_of()), styled=True)
