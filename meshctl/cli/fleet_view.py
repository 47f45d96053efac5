"""What `status`, `preflight` and `topology` share: a `Watcher` over everything, who is asked, and how wide to write.

`watcher` opens the fleet and finds a way to its radios and robots, for a command `with_everybody` by its options;
`glance` takes one snapshot, with its progress told on a terminal.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath, KeyFiles, Lab, Options, Session, session, with_options
from meshctl.cli.output import is_plain
from meshctl.cli.robots_context import AskSudo, sudo_password
from meshctl.device.connection import Deadlines
from meshctl.model import Fleet, Node
from meshctl.robots.connection import RobotConnector
from meshctl.status.assess import Snapshot
from meshctl.status.collect import Collector, Progress
from meshctl.status.table import Paint, plain

# A look wants to be quick: in this time TCP asks three times (RFC 6298: after 1 and 3 s), and a mesh that answers at
# all answers one of them. Provisioning, which must not give up early, waits longer.
CONNECT_S = 5.0

Timeout = Annotated[
    float,
    typer.Option(
        "--timeout",
        min=0.5,
        metavar="S",
        help="Seconds a device has to take a connection; twice that for each step after it.",
    ),
]
NoRobots = Annotated[bool, typer.Option("--no-robots", help="Ask the radios alone, not the robots' computers.")]

# Of commands that look: the options by which `watcher` opens fleet_view.
_SHARED: Options = {
    "inventory": (InventoryPath, Path()),
    "no_robots": (NoRobots, False),
    "timeout": (Timeout, CONNECT_S),
    "ask_sudo": (AskSudo, False),
    "key": (KeyFiles, None),
    "lab": (Lab, None),
}
_COLOURS = {
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
    """A fleet opened for looking, and who is in it: its managed radios, its robots with a computer we can reach."""

    opened: Session
    watcher: Collector
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
) -> Iterator[FleetView]:
    """Open all of it, and close it in the end. Raises InvalidInput, InputError, MeshctlError."""
    password = None if no_robots else sudo_password(ask_sudo)
    with session(inventory, key_files=key or (), lab=lab) as opened:
        opened.access.deadlines = _deadlines(timeout)
        robots, skipped = _robots(opened, not no_robots)
        connector = RobotConnector(opened.fleet, opened.access, lambda: password) if robots else None
        with Collector(
            opened.fleet, opened.renderer, opened.access, opened.journal, opened.owner, connector, skipped
        ) as watching:
            yield FleetView(opened, watching, tuple(opened.fleet.managed()), robots)


def with_fleet_view(command: Callable[..., None]) -> Callable[..., None]:
    """A command that takes `everybody` and options of its own becomes one that has those of looking, and opens them."""
    return with_options("fleet_view", open_fleet_view, _SHARED)(command)


def _deadlines(connect_s: float) -> Deadlines:
    """Each further step has twice that: it computes, on a small processor, besides travelling."""
    return Deadlines(connect_s, handshake_s=2 * connect_s, auth_s=2 * connect_s, channel_s=2 * connect_s)


def _robots(opened: Session, with_robots: bool) -> tuple[tuple[str, ...], str]:
    """The robots to ask; where there are some and none is asked, why."""
    able = {name: robot.computer for name, robot in opened.fleet.robots.items() if robot.computer is not None}
    if not with_robots:
        return (), "the robots' computers were not asked (--no-robots)" if able else ""
    if opened.lab is None:
        return tuple(able), ""
    # what the inventory calls 10.42.0.21 may be somebody's real machine; a virtual fleet is reached on loopback alone
    named = tuple(name for name, computer in able.items() if computer.ssh.host)
    if named or not able:
        return named, ""
    return (), "the robots' computers were not asked: with --lab only one of which the inventory gives ssh.host is"


def collect(
    fleet_view: FleetView,
    nodes: Iterable[Node] | None = None,
    robots: Iterable[str] | None = None,
    *,
    show_progress: bool = True,
) -> Snapshot:
    """One look at these (default: fleet_view); `show_progress` is how far it is, where the terminal is not a page's."""
    return fleet_view.watcher.collect(
        fleet_view.nodes if nodes is None else nodes,
        fleet_view.robots if robots is None else robots,
        _progress(show_progress=show_progress),
    )


def _progress(*, show_progress: bool) -> Progress:
    """A line that counts up on a terminal, and is gone in the end."""
    if not (show_progress and sys.stderr.isatty()):
        return lambda done, count: None

    def tell(done: int, count: int) -> None:
        text = "" if done == count else f"{done} of {count} have answered or given up"
        sys.stderr.write(f"\r\x1b[K{text}")
        sys.stderr.flush()

    return tell


def paint_of() -> Paint:
    """Colours on a terminal, unless NO_COLOR (no-color.org) is set."""
    return paint if sys.stdout.isatty() and not is_plain() else plain


def paint(text: str, style: str) -> str:
    """Terminal colours."""
    given = _COLOURS.get(style)
    return typer.style(text, **given) if given else text  # type: ignore[arg-type]
