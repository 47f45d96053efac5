"""`meshctl sites status`: the worker of each site and, with `--nodes`, what it says about its nodes.

Each worker runs `meshctl status` at its site, so the operator's side costs one uplink per site, however many nodes it
has.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from meshctl.cli.context import Session
from meshctl.cli.output import echo
from meshctl.errors import ExitCode, MeshctlError, Unreachable
from meshctl.model import Site
from meshctl.report.duration import duration
from meshctl.sites.bundle import site_bundle
from meshctl.sites.connect import open_uplink, waiting_orders
from meshctl.sites.dispatch import MAX_SITES_AT_ONCE, new_run_id
from meshctl.sites.protocol import WorkerError
from meshctl.sites.uplink import Greeting, Uplink
from meshctl.wording import counted

_MAX_ALARMS = 20
_SHOWN_LEVELS = ("error", "warning")


@dataclass(frozen=True, slots=True)
class SiteStatus:
    """One site's answer: its worker's `greeting`, or the `error` instead; `nodes` is a status as JSON."""

    site: Site
    greeting: Greeting | None = None
    error: MeshctlError | None = None
    nodes: dict[str, Any] = field(default_factory=dict)
    # the runs whose orders wait for the site at the hub
    waiting: tuple[str, ...] = ()

    @property
    def exit_code(self) -> ExitCode:
        if self.error is not None:
            return ExitCode.UNREACHABLE if isinstance(self.error, Unreachable) else ExitCode.FINDINGS
        return ExitCode(int(self.nodes.get("exit_code", ExitCode.OK)))


def query_sites(opened: Session, inventory: Path, sites: tuple[Site, ...], *, with_nodes: bool) -> list[SiteStatus]:
    """Ask all sites at the same time."""

    def ask(site: Site) -> SiteStatus:
        waiting: tuple[str, ...] = ()
        try:
            waiting = waiting_orders(opened.fleet, site, opened.access)
            with open_uplink(opened.fleet, site, opened.access) as uplink:
                nodes = _nodes(opened, inventory, site, uplink) if with_nodes else {}
                return SiteStatus(site, uplink.greeting, nodes=nodes, waiting=waiting)
        except MeshctlError as error:
            return SiteStatus(site, error=error, waiting=waiting)

    with ThreadPoolExecutor(min(MAX_SITES_AT_ONCE, len(sites)), "site") as pool:
        return list(pool.map(ask, sites))


def _nodes(opened: Session, inventory: Path, site: Site, uplink: Uplink) -> dict[str, Any]:
    names = [node.name for node in opened.fleet.managed() if node.site == site.name]
    bundle = site_bundle(
        inventory, opened.fleet, site.name, opened.renderer.secrets, opened.trust, os.environ, with_firmware=False
    )
    text = uplink.status(new_run_id(), bundle.archive, names, ["--no-robots"])
    try:
        found = json.loads(text)
    except ValueError as error:
        raise WorkerError(f"site {site.name}: its status is not JSON: {error}") from error
    return found if isinstance(found, dict) else {}


def exit_code(found: list[SiteStatus]) -> ExitCode:
    """The worst of all sites: unreachable only if none could be asked."""
    codes = [each.exit_code for each in found]
    if all(code is ExitCode.OK for code in codes):
        return ExitCode.OK
    return ExitCode.UNREACHABLE if all(code is ExitCode.UNREACHABLE for code in codes) else ExitCode.FINDINGS


def show(found: list[SiteStatus]) -> None:
    width = max(len(each.site.name) for each in found)
    for each in found:
        first, *more = _lines(each)
        echo(f"{each.site.name:<{width}}  {first}")
        for line in more:
            echo(f"{'':<{width}}  {line}")


def _lines(status: SiteStatus) -> Iterator[str]:
    if status.greeting is None:
        yield str(status.error)
        if status.error is not None and status.error.hint:
            yield f"hint: {status.error.hint}"
        yield from _waiting_lines(status)
        return
    run = next((each for each in status.greeting.runs if each.state != "prepared"), None)
    last = "no run yet"
    if run is not None:
        last = f"{run.command} by {run.operator} {duration(max(0.0, time.time() - run.began_s))} ago: {run.state}"
    yield f"{_counts(status.nodes)}meshctl {status.greeting.version}, {last}"
    yield from _waiting_lines(status)
    yield from _alarm_lines(status.nodes)


def _waiting_lines(status: SiteStatus) -> Iterator[str]:
    for run in status.waiting:
        yield f"the order of run {run} waits; `meshctl sites cancel {status.site.name} {run}` deletes it"


def _counts(nodes: dict[str, Any]) -> str:
    """`48 ok, 2 unreachable; `."""
    totals = nodes.get("totals", {}).get("nodes", {}) if nodes else {}
    counted = [f"{count} {health}" for health, count in totals.items() if count]
    return f"{', '.join(counted)}; " if counted else ""


def _alarm_lines(nodes: dict[str, Any]) -> Iterator[str]:
    alarms = [
        (str(node.get("name", "")), alarm)
        for node in ({"alarms": nodes.get("alarms", [])}, *nodes.get("nodes", []))
        for alarm in node.get("alarms", [])
        if alarm.get("level") in _SHOWN_LEVELS
    ]
    for name, alarm in alarms[:_MAX_ALARMS]:
        yield f"{alarm['level']}: {f'{name}: ' if name else ''}{alarm['text']}"
    if len(alarms) > _MAX_ALARMS:
        yield f"... and {counted(len(alarms) - _MAX_ALARMS, 'more alarm')} (--json has them all)"


def as_object(status: SiteStatus) -> dict[str, object]:
    if status.greeting is None:
        error = status.error or MeshctlError("no answer")
        return {"site": status.site.name, "error": str(error), "hint": error.hint, "waiting": list(status.waiting)}
    runs = [
        {
            "run": each.run,
            "state": each.state,
            "operator": each.operator,
            "command": each.command,
            "began_s": each.began_s,
        }
        for each in status.greeting.runs
    ]
    return {
        "site": status.site.name,
        "meshctl": status.greeting.version,
        "operators": list(status.greeting.operators),
        "runs": runs,
        "waiting": list(status.waiting),
        **({"status": status.nodes} if status.nodes else {}),
    }
