"""The read-only view of the fleet that `status`, `preflight` and `topology` share: its radios and its robots.

`with_fleet_view` adds the shared options to a command; `open_fleet_view` opens the connections; `collect` takes one
snapshot, with progress on a terminal.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshctl.cli.context import InventoryPath, KeyFiles, Lab, Options, Session, session, with_options
from meshctl.cli.output import has_transient_line, is_plain, transient_line
from meshctl.cli.robots_context import AskSudo, sudo_password
from meshctl.device.connection import Deadlines
from meshctl.model import Fleet, Node, Site
from meshctl.robots.connection import RobotConnector
from meshctl.status.assess import Snapshot
from meshctl.status.collect import Collector, Progress
from meshctl.status.table import Paint, plain

if TYPE_CHECKING:
    from meshctl.status.site_observer import SiteObserver

# Short, since a status should be quick: TCP sends three SYNs in this time (RFC 6298: after 1 and 3 s). Provisioning,
# which must not give up early, waits longer.
CONNECT_S = 5.0

Timeout = Annotated[
    float,
    typer.Option(
        "--timeout",
        min=0.5,
        metavar="S",
        help="Connection timeout in seconds; each later step gets twice as long.",
    ),
]
Direct = Annotated[
    bool,
    typer.Option("--direct", help="Connect to nodes of sites from here, instead of through their workers."),
]
NoRobots = Annotated[bool, typer.Option("--no-robots", help="Query only the radios, not the robots' computers.")]

# Options of read-only commands, by the parameters of `open_fleet_view`.
_SHARED: Options = {
    "inventory": (InventoryPath, Path()),
    "no_robots": (NoRobots, False),
    "direct": (Direct, False),
    "timeout": (Timeout, CONNECT_S),
    "ask_sudo": (AskSudo, False),
    "key": (KeyFiles, None),
    "lab": (Lab, None),
}
_COLORS = {
    "ok": {"fg": "green"},
    "degraded": {"fg": "yellow", "bold": True},
    "unreachable": {"fg": "red", "bold": True},
    "off": {"dim": True},
    "known": {"dim": True},
    "note": {"dim": True},
    "heading": {"bold": True},
    "warning": {"fg": "yellow", "bold": True},
    "error": {"fg": "red", "bold": True},
}


@dataclass(frozen=True, slots=True)
class FleetView:
    """A fleet opened for reading: its managed radios, and its robots whose computer can be queried."""

    opened: Session
    collector: Collector
    nodes: tuple[Node, ...]
    robots: tuple[str, ...]

    @property
    def fleet(self) -> Fleet:
        return self.opened.fleet


@contextmanager
def open_fleet_view(
    inventory: Path,
    *,
    key: Iterable[Path] | None,
    lab: Path | None,
    timeout: float = CONNECT_S,
    ask_sudo: bool = False,
    no_robots: bool = False,
    direct: bool = False,
) -> Iterator[FleetView]:
    """Open the fleet and close it at the end. Raises InvalidInput, InputError, MeshctlError."""
    password = None if no_robots else sudo_password(ask_sudo)
    with session(inventory, key_files=key or (), lab=lab, changes_nothing=True) as opened:
        opened.access.deadlines = query_deadlines(timeout)
        robots, skipped = _robots(opened, not no_robots)
        connector = RobotConnector(opened.fleet, opened.access, lambda: password) if robots else None
        sites = None if direct else site_observer(opened, inventory)
        with Collector(
            opened.fleet, opened.renderer, opened.access, opened.journal, opened.owner, connector, skipped, sites
        ) as collector:
            yield FleetView(opened, collector, tuple(opened.fleet.managed()), robots)


def site_observer(opened: Session, inventory: Path) -> SiteObserver | None:
    """The observer of sites with a worker; None if no site has one."""
    if not any(site.worker_key for site in opened.fleet.sites.values()):
        return None
    # with what only sites need
    from meshctl.sites.bundle import site_bundle
    from meshctl.status.site_observer import SiteObserver

    def part_of(site: Site) -> bytes:
        secrets, trust = opened.renderer.secrets, opened.trust
        return site_bundle(inventory, opened.fleet, site.name, secrets, trust, os.environ, with_firmware=False).archive

    return SiteObserver(opened.fleet, opened.access, part_of)


def with_fleet_view(command: Callable[..., None]) -> Callable[..., None]:
    """Add the shared options to a command that takes `fleet_view`, and open the view for it."""
    return with_options("fleet_view", open_fleet_view, _SHARED)(command)


def query_deadlines(connect_s: float) -> Deadlines:
    """Later steps get twice as long: they also take computation on a slow processor. So may a kept connection be
    silent, because a snapshot is complete only when every device has answered or is given up."""
    later_s = 2 * connect_s
    ask_s = min(connect_s, Deadlines().ask_s)
    return Deadlines(connect_s, handshake_s=later_s, auth_s=later_s, channel_s=later_s, ask_s=ask_s, silence_s=later_s)


def _robots(opened: Session, with_robots: bool) -> tuple[tuple[str, ...], str]:
    """The robots to query, and the reason if none is although there are some."""
    able = {name: robot.computer for name, robot in opened.fleet.robots.items() if robot.computer is not None}
    if not with_robots:
        return (), "robots were not queried (--no-robots)" if able else ""
    if opened.lab is None:
        return tuple(able), ""
    # 10.42.0.21 may be a real machine on this network; a virtual fleet is reached on loopback only
    named = tuple(name for name, computer in able.items() if computer.ssh.host)
    if named or not able:
        return named, ""
    return (), "robots were not queried: --lab queries only computers with ssh.host in the inventory"


def collect(
    fleet_view: FleetView,
    nodes: Iterable[Node] | None = None,
    robots: Iterable[str] | None = None,
    *,
    show_progress: bool = True,
) -> Snapshot:
    """One snapshot of these nodes and robots (default: all); `show_progress` counts answers on a terminal."""
    return fleet_view.collector.collect(
        fleet_view.nodes if nodes is None else nodes,
        fleet_view.robots if robots is None else robots,
        _progress(show_progress=show_progress),
    )


def _progress(*, show_progress: bool) -> Progress:
    """A counter on the terminal that is erased at the end."""
    if not (show_progress and has_transient_line()):
        return lambda done, count: None

    def show(done: int, count: int) -> None:
        transient_line("" if done == count else f"queried {done} of {count}")

    return show


def paint_of() -> Paint:
    """Colors on a terminal, unless NO_COLOR is set (no-color.org)."""
    return paint if sys.stdout.isatty() and not is_plain() else plain


def paint(text: str, style: str) -> str:
    """Apply a style as terminal colors."""
    given = _COLORS.get(style)
    return typer.style(text, **given) if given else text  # type: ignore[arg-type]
