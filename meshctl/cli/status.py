"""`meshctl status`: one look at all radios and robots, as a table, as JSON, once or until Ctrl-C."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Annotated

import typer

from meshctl.cli.context import AsJson, line_width
from meshctl.cli.fleet_view import FleetView, collect, paint_of, with_fleet_view
from meshctl.cli.live_screen import live_screen
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode
from meshctl.status import Check, FleetStatus, assess
from meshctl.status import preflight as checks_of
from meshctl.status.assess import Snapshot
from meshctl.status.filters import ROLES, STATES, Filter
from meshctl.status.json_output import as_json as status_json
from meshctl.status.json_output import preflight_json
from meshctl.status.last_known import facts_to_record
from meshctl.status.robots import is_active
from meshctl.status.text import preflight_text, text

Names = Annotated[
    list[str] | None, typer.Argument(metavar="[NAME]...", help="Radios and robots, or patterns: 'husky*'.")
]


@with_fleet_view
def status(
    fleet_view: FleetView,
    names: Names = None,
    watch: Annotated[
        float | None,
        typer.Option("--watch", "-w", min=1.0, metavar="S", help="Look again every S seconds; Ctrl-C ends."),
    ] = None,
    group: Annotated[list[str] | None, typer.Option("--group", help="Only members of this group.")] = None,
    robot: Annotated[list[str] | None, typer.Option("--robot", help="Only this robot's radios and computer.")] = None,
    role: Annotated[list[str] | None, typer.Option("--role", help=f"Only {', '.join(ROLES)}.")] = None,
    state: Annotated[list[str] | None, typer.Option("--state", help=f"Only {', '.join(STATES)}.")] = None,
    alarm: Annotated[
        list[str] | None,
        typer.Option("--alarm", help="Only with this alarm: a code, error, warning, note, or any (error or warning)."),
    ] = None,
    only: Annotated[
        bool, typer.Option("--only", help="Ask only those shown: quicker, without hops and who hears the silent.")
    ] = False,
    topics: Annotated[bool, typer.Option("--topics", help="Add when each topic was last sent and received.")] = False,
    wide: Annotated[bool, typer.Option("--wide", help="All columns, however wide the terminal.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show every radio and every robot: does it answer, is it as the inventory says, whom does it hear, what is wrong.

    Names and filters choose what is shown; everybody is asked. Nothing is changed anywhere.

    Exit code: 0 all well, 1 something degraded, 3 somebody who must answer does not (of those shown), 2 could not look.

    Example: meshctl status --watch 5
    Example: meshctl status --role beacon --state deployed
    Example: meshctl status --alarm any
    """
    chosen = Filter(*(tuple(values or ()) for values in (names, group, robot, role, state, alarm)))
    chosen.check(fleet_view.fleet)
    query = _StatusQuery(fleet_view, chosen, only, topics, wide)
    if watch is None:
        found = query.status(query.collect(), time.time())
        if as_json:
            echo_json(json.dumps(status_json(found), indent=2))
        else:
            echo(query.text(found), styled=True)
        raise typer.Exit(found.exit_code)
    if as_json or not sys.stdout.isatty():
        _follow(query, watch, as_json)
    _watch(query, watch)


class _StatusQuery:
    """Which part of the fleet is looked at, and how it is shown."""

    def __init__(self, fleet_view: FleetView, chosen: Filter, only: bool, topics: bool, wide: bool) -> None:
        self._fleet_view = fleet_view
        self._chosen = chosen
        self._topics = topics
        self._wide = wide
        fleet = fleet_view.fleet
        self._is_partial = only and not chosen.is_empty
        self._nodes = tuple(n for n in fleet_view.nodes if not only or chosen.matches_node(n))
        self._robots = tuple(name for name in fleet_view.robots if not only or chosen.matches_robot(fleet, name))

    def collect(self, *, show_progress: bool = True) -> Snapshot:
        """Ask, and remember what was told; `show_progress`: count the answers on the terminal."""
        snapshot = collect(self._fleet_view, self._nodes, self._robots, show_progress=show_progress)
        snapshot = replace(snapshot, is_partial=self._is_partial)
        whole = assess(snapshot, self._nodes, time.time(), self._robots)
        self._fleet_view.opened.journal.remember_all(self._fleet_view.fleet.name, facts_to_record(whole), time.time())
        return snapshot

    def status(self, snapshot: Snapshot, now: float) -> FleetStatus:
        """Of those that are shown, with ages as of `now`."""
        return self._chosen.apply(self._fleet_view.fleet, assess(snapshot, self._nodes, now, self._robots))

    def text(self, status: FleetStatus, width: int | None = None, *, brief: bool = False) -> str:
        room = width if width is not None and not self._wide else line_width(wide=self._wide)
        return text(status, room, paint_of(), topics=self._topics, brief=brief)


def _follow(query: _StatusQuery, period_s: float, as_json: bool) -> None:
    """One look after the other, for pipes and logs: JSON lines, or the text with a blank line behind."""
    while True:
        began = time.monotonic()
        found = query.status(query.collect(), time.time())
        if as_json:
            echo_json(json.dumps(status_json(found)))
        else:
            echo(query.text(found) + "\n", styled=True)
        time.sleep(max(0.0, period_s - (time.monotonic() - began)))


def _watch(query: _StatusQuery, period_s: float) -> None:
    """The page until Ctrl-C; then what was seen last, where it stays."""

    def draw(snapshot: Snapshot | None, size: os.terminal_size) -> list[str]:
        if snapshot is None:
            return ["looking at everybody for the first time ... (Ctrl-C ends)"]
        status = query.status(snapshot, time.time())
        footer = ["", f"a look every {period_s:g} s; Ctrl-C ends"]
        lines = [*query.text(status, size.columns).splitlines(), *footer]
        if len(lines) > size.lines:
            # in a small window the table comes before notes and advice
            lines = [*query.text(status, size.columns, brief=True).splitlines(), *footer]
        return lines

    latest = live_screen(partial(query.collect, show_progress=False), draw, period_s, sys.stdout)
    if latest is not None:
        echo(query.text(query.status(latest, time.time())), styled=True)
    raise typer.Exit(ExitCode.INTERRUPTED)


@with_fleet_view
def preflight(fleet_view: FleetView, as_json: AsJson = False) -> None:
    """Go or no-go for the run: one line per check, with the reason. Urgent messages are really sent between all robots.

    Exit code: 0 go, 1 no-go, 2 could not look.

    Example: meshctl preflight
    """
    found = assess(collect(fleet_view), fleet_view.nodes, time.time(), fleet_view.robots)
    fleet_view.opened.journal.remember_all(fleet_view.fleet.name, facts_to_record(found), time.time())
    talking = [
        robot.name
        for robot in found.robots
        if is_active(robot.state) and robot.facts is not None and robot.facts.answers
    ]
    checks = checks_of(fleet_view.fleet, found, fleet_view.watcher.ping(talking))
    show_preflight(checks, as_json=as_json)
    raise typer.Exit(ExitCode.OK if all(check.is_go for check in checks) else ExitCode.FINDINGS)


def show_preflight(checks: Sequence[Check], *, as_json: bool) -> None:
    """Print the checks and the verdict."""
    if as_json:
        echo_json(json.dumps(preflight_json(checks), indent=2))
    else:
        echo(preflight_text(checks, line_width(), paint_of()), styled=True)
