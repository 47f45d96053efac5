"""What every command that talks to nodes opens first: the fleet, its secrets, its host keys, its journal.

`session` opens them, `chosen` picks nodes by name or pattern, `progress_for` picks how a run is shown, `exit_for` turns
outcomes into an exit code.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshctl.cli.extensions import LabFleet, attach_lab
from meshctl.cli.output import console
from meshctl.device.trust import TrustStore
from meshctl.errors import ExitCode, InputError
from meshctl.fleet import Interrupt, Outcome, totals
from meshctl.fleet.journal import Journal, default_path
from meshctl.fleet.lab_directory import lab_of
from meshctl.fleet.process import lock_owner
from meshctl.inventory import load_fleet
from meshctl.inventory.secrets import SecretStore
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Node
from meshctl.nodes.connections import ConnectionPool, Locate, as_written
from meshctl.nodes.desired import Renderer

if TYPE_CHECKING:
    from meshctl.report.progress import Progress

KeyFiles = Annotated[
    list[Path] | None,
    typer.Option("--key", help="Private key file to log in with, before those of the inventory and the agent."),
]
Lab = Annotated[
    Path | None,
    typer.Option("--lab", envvar="MESHCTL_LAB", help="Reach the nodes of the virtual fleet that runs in DIR."),
]
Nodes = Annotated[list[str] | None, typer.Argument(help="Nodes, or patterns such as 'husky*'; default: all.")]


@dataclass(frozen=True, slots=True)
class Session:
    """Everything open. `owner` names this process to the locks on the nodes; `lab` is set for a virtual fleet."""

    fleet: Fleet
    renderer: Renderer
    access: ConnectionPool
    journal: Journal
    trust: TrustStore
    owner: str
    inventory: str
    interrupt: Interrupt
    lab: LabFleet | None = None


@contextmanager
def session(inventory: Path, *, key_files: Iterable[Path] = (), lab: Path | None = None) -> Iterator[Session]:
    """Open all of it, and close it in the end. Raises InvalidInput, InputError, MeshctlError."""
    fleet = load_fleet(inventory, environ=os.environ)
    trust = trust_of(fleet)
    virtual, locate = _lab(lab)
    # commands without --lab work on the copy, too
    lab_directory = str(virtual.directory) if virtual is not None else lab_of(str(inventory.resolve()))
    with (
        Journal(default_path(os.environ), lab=lab_directory) as journal,
        ConnectionPool(fleet, trust, key_files=tuple(key_files), locate=locate) as access,
    ):
        journal.move_lab_runs(fleet.name, lab_of)
        yield Session(
            fleet,
            Renderer.of(fleet, SecretStore(os.environ, Path(fleet.base)).get),
            access,
            journal,
            trust,
            lock_owner(),
            str(inventory.resolve()),
            Interrupt(),
            virtual,
        )


def trust_of(fleet: Fleet) -> TrustStore:
    """The fleet's own file of host keys, beside the inventory."""
    path = Path(fleet.operators.known_hosts).expanduser()
    pinned = {node.name: node.host_keys for node in fleet.nodes.values() if node.host_keys}
    return TrustStore(path if path.is_absolute() else Path(fleet.base) / path, inventory=pinned)


def _lab(directory: Path | None) -> tuple[LabFleet | None, Locate]:
    if directory is None:
        return None, as_written

    virtual = attach_lab(directory)

    def locate(node: Node, address: object) -> tuple[str, int]:
        endpoint = virtual.endpoint(str(address))
        return endpoint.host, endpoint.port

    return virtual, locate


def chosen(fleet: Fleet, patterns: Iterable[str] | None) -> tuple[Node, ...]:
    """The managed nodes that a name or pattern selects, in the inventory's order; all when none is given.

    Raises InputError for a pattern that selects nothing.
    """
    wanted = list(patterns or ())
    managed = {node.name: node for node in fleet.managed()}
    if not wanted:
        return tuple(managed.values())
    for pattern in wanted:
        if not any(fnmatchcase(name, pattern) for name in managed):
            raise InputError(
                f"no managed node of {fleet.name} is called {pattern!r}",
                hint=did_you_mean(pattern, managed) or "`meshctl inventory list` shows all",
            )
    return tuple(node for name, node in managed.items() if any(fnmatchcase(name, pattern) for pattern in wanted))


def progress_for(count: int, *, as_json: bool) -> Progress:
    """Live lines on a terminal, JSON lines for programs, plain lines elsewhere."""
    from meshctl.report.progress import Aside, JsonProgress, LiveProgress, PlainProgress

    if as_json:
        return Aside(JsonProgress(sys.stdout))
    if sys.stdout.isatty():
        return Aside(LiveProgress(console(), count))
    return Aside(PlainProgress(sys.stdout))


def exit_for(outcomes: Iterable[Outcome], interrupt: Interrupt) -> ExitCode:
    """OK, FINDINGS, UNREACHABLE or INTERRUPTED."""
    counted = totals(outcomes)
    if interrupt.stopping:
        return ExitCode.INTERRUPTED
    if counted.all_good:
        return ExitCode.OK
    return ExitCode.UNREACHABLE if counted.none_reached else ExitCode.FINDINGS
