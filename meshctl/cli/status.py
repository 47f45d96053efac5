"""`meshctl status` and `meshctl preflight`: a snapshot of all radios and robots; the go/no-go checks."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import AsJson, Limit, confirm, line_width, read_selection
from meshctl.cli.fleet_view import FleetView, collect, paint_of, with_fleet_view
from meshctl.cli.live_screen import live_screen
from meshctl.cli.node_completion import complete_nodes
from meshctl.cli.output import echo, echo_json
from meshctl.errors import ExitCode, InputError
from meshctl.status import Check, FleetStatus, assess
from meshctl.status import preflight as checks_of
from meshctl.status.assess import Snapshot
from meshctl.status.emergency_stop import StopResult, stop_plan
from meshctl.status.filters import ROLES, STATES, Filter, select_devices
from meshctl.status.json_output import as_json as status_json
from meshctl.status.json_output import preflight_json
from meshctl.status.last_known import facts_to_record
from meshctl.status.robots import is_active
from meshctl.status.text import preflight_text, text

Names = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="NAME",
        help="Radios and robots: names, patterns, groups, role:beacon, '!b07', @FILE; default: all.",
        autocompletion=complete_nodes,
    ),
]


@with_fleet_view
def status(
    fleet_view: FleetView,
    names: Names = None,
    limit: Limit = None,
    watch: Annotated[
        float | None,
        typer.Option("--watch", "-w", min=1.0, metavar="S", help="Refresh every S seconds until Ctrl-C."),
    ] = None,
    group: Annotated[list[str] | None, typer.Option("--group", help="Only members of this group.")] = None,
    robot: Annotated[list[str] | None, typer.Option("--robot", help="Only this robot's radios and computer.")] = None,
    role: Annotated[list[str] | None, typer.Option("--role", help=f"Only this role: {', '.join(ROLES)}.")] = None,
    state: Annotated[list[str] | None, typer.Option("--state", help=f"Only this state: {', '.join(STATES)}.")] = None,
    alarm: Annotated[
        list[str] | None,
        typer.Option("--alarm", help="Only with this alarm: a code, error, warning, note, or any (error or warning)."),
    ] = None,
    only: Annotated[
        bool,
        typer.Option("--only", help="Query only the selected devices: faster, without hop counts and 'heard by'."),
    ] = False,
    topics: Annotated[bool, typer.Option("--topics", help="Also show the age of each topic's messages.")] = False,
    wide: Annotated[bool, typer.Option("--wide", help="Show all columns regardless of the terminal width.")] = False,
    as_json: AsJson = False,
    answers: Annotated[
        bool, typer.Option("--answers", hidden=True, help="Print the radios' raw answers, for another meshctl to read.")
    ] = False,
) -> None:
    """Show the state of every radio and robot: reachability, drift from the inventory, neighbors and alarms.

    Names and filters select what is shown; all devices are queried (see --only). Changes nothing.

    Exit code (of the devices shown): 0 healthy, 1 degraded, 3 a required device is unreachable, 2 could not run.

    Example: meshctl status --watch 5

    Example: meshctl status role:beacon --limit state:deployed

    Example: meshctl status --alarm any
    """
    attributes = {"group": group or (), "robot": robot or (), "role": role or (), "state": state or ()}
    chosen = select_devices(fleet_view.fleet, names or (), read_selection, limit or (), attributes, alarm or ())
    query = _StatusQuery(fleet_view, chosen, only, topics, wide)
    if answers:
        echo_json(json.dumps(query.answers()))
        return
    if watch is None:
        found = query.latest()
        if as_json:
            echo_json(json.dumps(status_json(found), indent=2))
        else:
            echo(query.text(found), styled=True)
        raise typer.Exit(found.exit_code)
    if as_json or not sys.stdout.isatty():
        _follow(query, watch, as_json)
    _watch(query, watch)


class _StatusQuery:
    """Selects the part of the fleet to query, and how to show it."""

    def __init__(self, fleet_view: FleetView, chosen: Filter, only: bool, topics: bool, wide: bool) -> None:
        self._fleet_view = fleet_view
        self._chosen = chosen
        self._topics = topics
        self._wide = wide
        self._is_partial = only and not chosen.is_empty
        self._nodes = tuple(node for node in fleet_view.nodes if not only or chosen.selects_node(node.name))
        self._robots = tuple(name for name in fleet_view.robots if not only or chosen.selects_robot(name))

    def collect(self, *, show_progress: bool = True) -> Snapshot:
        """Take a snapshot and record it in the journal; `show_progress` counts answers on a terminal."""
        return self._collected(show_progress=show_progress)[0]

    def latest(self) -> FleetStatus:
        """The same, and the status of the selected devices in it."""
        return self._chosen.apply(self._collected(show_progress=True)[1])

    def _collected(self, *, show_progress: bool) -> tuple[Snapshot, FleetStatus]:
        snapshot = collect(self._fleet_view, self._nodes, self._robots, show_progress=show_progress)
        snapshot = replace(snapshot, is_partial=self._is_partial)
        whole = assess(snapshot, self._nodes, time.time(), self._robots)
        self._fleet_view.opened.journal.remember_all(self._fleet_view.fleet.name, facts_to_record(whole), time.time())
        return snapshot, whole

    def answers(self) -> dict[str, object]:
        """The nodes' answers, for the operator that queried a site's worker."""
        from meshctl.status.site_observer import answers_json

        collector = self._fleet_view.collector
        return answers_json(collector.answers(self._nodes), time.time(), collector.traffic())

    def status(self, snapshot: Snapshot, now: float) -> FleetStatus:
        """The status of the selected devices, with ages as of `now`."""
        return self._chosen.apply(assess(snapshot, self._nodes, now, self._robots))

    def text(self, status: FleetStatus, width: int | None = None, *, brief: bool = False) -> str:
        room = width if width is not None and not self._wide else line_width(wide=self._wide)
        return text(status, room, paint_of(), topics=self._topics, brief=brief)


def _follow(query: _StatusQuery, period_s: float, as_json: bool) -> None:
    """Repeated snapshots for pipes and logs: JSON lines, or text blocks separated by blank lines."""
    while True:
        began = time.monotonic()
        found = query.latest()
        if as_json:
            echo_json(json.dumps(status_json(found)))
        else:
            echo(query.text(found) + "\n", styled=True)
        time.sleep(max(0.0, period_s - (time.monotonic() - began)))


def _watch(query: _StatusQuery, period_s: float) -> None:
    """The live screen until Ctrl-C, then the last snapshot as plain output."""

    def draw(snapshot: Snapshot | None, size: os.terminal_size) -> list[str]:
        if snapshot is None:
            return ["querying all devices ... (Ctrl-C to quit)"]
        status = query.status(snapshot, time.time())
        footer = ["", f"refreshed every {period_s:g} s; Ctrl-C to quit"]
        lines = [*query.text(status, size.columns).splitlines(), *footer]
        if len(lines) > size.lines:
            # in a small window, drop notes and hints to keep the table
            lines = [*query.text(status, size.columns, brief=True).splitlines(), *footer]
        return lines

    latest = live_screen(partial(query.collect, show_progress=False), draw, period_s, sys.stdout)
    if latest is not None:
        echo(query.text(query.status(latest, time.time())), styled=True)
    raise typer.Exit(ExitCode.INTERRUPTED)


@with_fleet_view
def preflight(
    fleet_view: FleetView,
    names: Names = None,
    limit: Limit = None,
    send_estop: Annotated[
        Path | None,
        typer.Option(
            "--send-estop",
            metavar="FILE",
            help="Also send FILE as a real emergency stop and require every acknowledgment. THE ROBOTS STOP.",
        ),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Send the emergency stop without confirmation.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run the go/no-go checks before a mission, including urgent test messages between all robots.

    Without --send-estop, no message reaches the robots' programs: test messages end at their daemons.

    With a selection, only those devices and their base must be ready; the verdict says that others were not checked.

    Exit code: 0 go, 1 no-go, 2 could not run.

    Example: meshctl preflight

    Example: meshctl preflight robot:husky1 robot:husky2
    """
    fleet = fleet_view.fleet
    chosen = select_devices(fleet, names or (), read_selection, limit or ())
    if chosen.nodes is not None and fleet.base_node is not None:
        bases = {base.name for name in chosen.nodes if (base := fleet.base_of(fleet.nodes[name])) is not None}
        chosen = replace(chosen, nodes=chosen.nodes | (bases or {fleet.base_node.name}))
    whole = assess(collect(fleet_view), fleet_view.nodes, time.time(), fleet_view.robots)
    fleet_view.opened.journal.remember_all(fleet.name, facts_to_record(whole), time.time())
    found = chosen.devices_of(whole)
    unselected = [device.title for device in whole if device not in tuple(found)]
    active = [robot for robot in found.robots if is_active(robot.state)]
    answering = [robot.name for robot in active if robot.facts is not None and robot.facts.answers]
    silent = [robot.name for robot in active if robot.name not in answering]
    pings = fleet_view.collector.ping(answering)
    stop = None if send_estop is None else _send_stop(fleet_view, answering, silent, send_estop, yes=yes)
    checks = checks_of(fleet, found, pings, unselected, stop)
    show_preflight(checks, as_json=as_json)
    raise typer.Exit(ExitCode.OK if all(check.is_go for check in checks) else ExitCode.FINDINGS)


def _send_stop(
    fleet_view: FleetView, answering: Sequence[str], silent: Sequence[str], file: Path, *, yes: bool
) -> StopResult:
    """Send the emergency stop in `file` to the robots whose daemons answer, after confirmation."""
    plan = stop_plan(fleet_view.fleet, answering, silent)
    if plan is None:
        raise InputError("--send-estop: the inventory has no topic of class emergency_stop, or no robot that sends it")
    try:
        message = file.read_bytes()
    except OSError as error:
        raise InputError(f"--send-estop: cannot read {file}: {error.strerror}") from error
    if not yes and plan.destinations:
        names = ", ".join(plan.destinations)
        confirm(f"Send a real emergency stop ({plan.topic.name}) from {plan.source}? These robots stop: {names}.")
    return fleet_view.collector.send_stop(plan, message)


def show_preflight(checks: Sequence[Check], *, as_json: bool) -> None:
    """Print the checks and the verdict."""
    if as_json:
        echo_json(json.dumps(preflight_json(checks), indent=2))
    else:
        echo(preflight_text(checks, line_width(), paint_of()), styled=True)
