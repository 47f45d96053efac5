"""`meshctl preflight`: one look, urgent messages between all robots, and go or no-go."""

from __future__ import annotations

import json
import time

import typer

from meshctl.cli.looking import Everybody, glance, paint_of, with_everybody
from meshctl.cli.options import AsJson, line_width
from meshctl.errors import ExitCode
from meshctl.status import assess
from meshctl.status import preflight as checks_of
from meshctl.status.document import preflight_json
from meshctl.status.memory import facts_to_keep
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
    is_go = all(check.is_go for check in checks)
    typer.echo(
        json.dumps(preflight_json(checks), indent=2) if as_json else preflight_text(checks, line_width(), paint_of())
    )
    raise typer.Exit(ExitCode.OK if is_go else ExitCode.FINDINGS)
