"""The context that every command opens to reach nodes, and the options that commands share.

`session` opens the fleet, its secrets, host keys and journal; `chosen` selects nodes by name or pattern; `progress_for`
selects how a run is shown; `exit_for` turns outcomes into an exit code.

Commands that open no session import this module for its options, so what only a session needs is imported in it.
"""

from __future__ import annotations

import inspect
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from meshctl import event_log
from meshctl.cli.extensions import LabFleet, attach_lab
from meshctl.cli.node_completion import complete_node, complete_nodes
from meshctl.cli.output import console, echo, echo_error
from meshctl.errors import ExitCode, InputError, MeshctlError
from meshctl.fleet import Interrupt, Outcome, totals
from meshctl.model import Fleet, Node

if TYPE_CHECKING:
    from meshctl.device.trust import TrustStore
    from meshctl.fleet.journal import Journal
    from meshctl.nodes.connections import ConnectionPool, Locate
    from meshctl.nodes.desired import Renderer
    from meshctl.report.progress import RunProgress

InventoryPath = Annotated[
    Path,
    typer.Option(
        "--inventory",
        "-i",
        envvar="MESHCTL_INVENTORY",
        help="Inventory: a YAML file, or a directory with fleet.yaml.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
LabDirectory = Annotated[
    Path | None,
    typer.Option(
        "--dir", metavar="DIR", envvar="MESHCTL_LAB", help="Directory of the lab; default: $XDG_STATE_HOME/meshctl/lab."
    ),
]
KeyFiles = Annotated[
    list[Path] | None,
    typer.Option("--key", help="SSH private key to try before those of the inventory and the agent."),
]
Lab = Annotated[
    Path | None,
    typer.Option("--lab", metavar="DIR", envvar="MESHCTL_LAB", help="Connect to the virtual fleet that runs in DIR."),
]
Nodes = Annotated[
    list[str] | None,
    typer.Argument(
        help="Nodes: names, patterns, groups, role:beacon, '!b07', @FILE; default: all.", autocompletion=complete_nodes
    ),
]
Limit = Annotated[
    list[str] | None,
    typer.Option(
        "--limit",
        "-l",
        metavar="NODES",
        help="Narrow the selection to nodes that match this, too; repeatable.",
        autocompletion=complete_nodes,
    ),
]

OneNode = Annotated[
    str,
    typer.Argument(help="The node: name, label, serial number or MAC.", autocompletion=complete_node),
]

DryRun = Annotated[bool, typer.Option("--dry-run", help="Show what would change, and change nothing.")]

Options = Mapping[str, tuple[Any, Any]]
"""Type and default of each option, by the opener's parameter name, in the order of the help."""


@dataclass(frozen=True, slots=True)
class Session:
    """The resources of a command. `owner` names this process in the nodes' locks; `lab` is set for a virtual fleet."""

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
def session(
    inventory: Path, *, key_files: Iterable[Path] = (), lab: Path | None = None, changes_nothing: bool = False
) -> Iterator[Session]:
    """Open a session and close it at the end; with `changes_nothing`, a journal that cannot be written is a warning.

    Raises InvalidInput, InputError, MeshctlError.
    """
    from meshctl.fleet.journal_store import open_journal
    from meshctl.fleet.lab_directory import lab_of
    from meshctl.fleet.lab_sites import without_real_gateways
    from meshctl.fleet.process import lock_owner
    from meshctl.inventory import load_fleet
    from meshctl.inventory.secrets import SecretStore
    from meshctl.nodes.collect import former_places
    from meshctl.nodes.connections import ConnectionPool
    from meshctl.nodes.desired import Renderer

    fleet = _with_parallel(load_fleet(inventory, environ=os.environ), os.environ.get("MESHCTL_PARALLEL", ""))
    virtual, lab_directory = lab_at(lab, inventory)
    if virtual is not None:
        fleet = without_real_gateways(fleet)
    trust = trust_of(fleet)
    with (
        open_journal(
            os.environ,
            echo_error,
            lab=lab_directory,
            pinned=lambda node: (key.fingerprint for key in trust.pinned(node)),
            changes_nothing=changes_nothing,
        ) as journal,
        ConnectionPool(fleet, trust, key_files=tuple(key_files), locate=locate_in(virtual)) as access,
    ):
        with suppress(MeshctlError) if changes_nothing else nullcontext():
            journal.move_lab_runs(fleet.name, lab_of)
        access.former_places = cache(lambda: former_places(fleet, journal.last_known(fleet.name)))
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


def _with_parallel(fleet: Fleet, wanted: str) -> Fleet:
    """The fleet with the operator's number of parallel connections, if given."""
    if not wanted:
        return fleet
    if not wanted.isdecimal() or int(wanted) < 1:
        raise InputError(f"MESHCTL_PARALLEL: expected an integer of 1 or more, found {wanted!r}")
    return replace(fleet, apply=replace(fleet.apply, parallel=int(wanted)))


def trust_of(fleet: Fleet) -> TrustStore:
    """The fleet's own known_hosts, beside the inventory."""
    from meshctl.device.trust import TrustStore
    from meshctl.inventory.file_paths import known_hosts_path

    pinned = {node.name: node.host_keys for node in fleet.nodes.values() if node.host_keys}
    return TrustStore(known_hosts_path(fleet), inventory=pinned)


def lab_at(given: Path | None, inventory: Path) -> tuple[LabFleet | None, str]:
    """The running virtual fleet, if one is given, and the directory of the lab that it or the inventory belongs to.

    Prints a note when the inventory is a lab's and no fleet is given, or another one than that of the fleet. Raises
    MeshctlError if no fleet runs there.
    """
    from meshctl.fleet.lab_directory import INVENTORY, lab_of

    directory = lab_of(str(inventory.resolve()))
    if given is not None:
        virtual = attach_lab(given)
        own = virtual.directory / INVENTORY
        if own.is_dir() and directory != str(virtual.directory.resolve()):
            echo(
                f"note: {inventory} is not the inventory of the lab in {virtual.directory}, whose nodes may have other "
                f"names at the same addresses: use -i {own}, or run `meshctl lab up` for this inventory",
                err=True,
            )
        return virtual, str(virtual.directory)
    # a lab's copy of the inventory also works without --lab
    if directory:
        # in another terminal, one of two variables is easily forgotten
        echo(
            f"note: the inventory is that of the lab in {directory}, but its addresses are used as those of real "
            f"devices: set MESHCTL_LAB={directory} to reach the lab",
            err=True,
        )
    return None, directory


def locate_in(virtual: LabFleet | None) -> Locate:
    """Where nodes are reached: at the virtual fleet's forwarded ports, or as the inventory says."""
    from meshctl.nodes.connections import as_written

    if virtual is None:
        return as_written

    def locate(node: Node, address: object) -> tuple[str, int]:
        endpoint = virtual.endpoint(str(address))
        return endpoint.host, endpoint.port

    return locate


def selected_nodes(
    fleet: Fleet,
    words: Iterable[str] | None,
    limits: Iterable[str] | None = None,
    *,
    in_word_order: bool = False,
    with_unmanaged: bool = False,
) -> tuple[Node, ...]:
    """The nodes that the words and every limit select (`inventory.selection`); all without words. Lost and retired ones
    only `with_unmanaged`.

    Raises InputError for a word that selects nothing.
    """
    from meshctl.inventory.selection import select_nodes

    return select_nodes(
        fleet, words or (), read_selection, limits or (), in_word_order=in_word_order, with_unmanaged=with_unmanaged
    )


def selected_node(fleet: Fleet, word: str, *, with_unmanaged: bool = False) -> Node:
    """The one node that the word selects. Raises InputError for none or several."""
    from meshctl.inventory.selection import select_one

    return select_one(fleet, word, read_selection, with_unmanaged=with_unmanaged)


def read_selection(path: str) -> str:
    """The text of `@FILE`; `-` is standard input. Raises OSError."""
    return sys.stdin.read() if path == "-" else Path(path).read_text(encoding="utf-8")


def progress_for(count: int, *, as_json: bool) -> RunProgress:
    """JSON lines with `as_json`, live lines on a terminal, plain lines elsewhere and with `--verbose`."""
    from meshctl.report.progress import JsonProgress, LiveProgress, PlainProgress, ThreadedProgress

    if as_json:
        return ThreadedProgress(JsonProgress(sys.stdout))
    # events on the same terminal would be painted over
    if sys.stdout.isatty() and not event_log.is_verbose():
        return ThreadedProgress(LiveProgress(console(), count))
    return ThreadedProgress(PlainProgress(sys.stdout))


def exit_for(outcomes: Iterable[Outcome], interrupt: Interrupt) -> ExitCode:
    """OK, FINDINGS, UNREACHABLE or INTERRUPTED."""
    counted = totals(outcomes)
    if interrupt.stopping:
        return ExitCode.INTERRUPTED
    if counted.all_good:
        return ExitCode.OK
    return ExitCode.UNREACHABLE if counted.none_reached else ExitCode.FINDINGS


def confirm(question: str) -> None:
    """Return if the user confirms.

    Raises InputError without a terminal, typer.Exit when the answer is no, typer.Abort at Ctrl-C or the end of input.
    """
    if not sys.stdin.isatty():
        raise InputError("not a terminal: cannot ask for confirmation", hint="review the plan, then pass --yes")
    if not typer.confirm(question):
        echo("canceled; nothing was changed", err=True)
        raise typer.Exit(int(ExitCode.FINDINGS))


def lab_directory(given: Path | None) -> Path:
    """The lab's absolute directory, by default below $XDG_STATE_HOME."""
    if given is not None:
        return given.absolute()
    home = os.environ.get("XDG_STATE_HOME") or Path("~/.local/state").expanduser()
    return Path(home) / "meshctl" / "lab"


def line_width(*, wide: bool = False) -> int | None:
    """Width of the terminal, or COLUMNS; None for unwrapped lines (`wide`, pipes)."""
    if wide or not (sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdecimal()):
        return None
    return shutil.get_terminal_size().columns


def with_options(
    parameter: str, opener: Callable[..., AbstractContextManager[Any]], options: Options
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add `options` to a command. They are passed to `opener`; the command gets what it yields as `parameter`."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        hints = get_type_hints(command, include_extras=True)
        keyword = inspect.Parameter.KEYWORD_ONLY
        own = [
            each.replace(annotation=hints[each.name], kind=keyword)
            for each in inspect.signature(command).parameters.values()
            if each.name != parameter
        ]
        shared = [
            inspect.Parameter(name, keyword, default=default, annotation=kind)
            for name, (kind, default) in options.items()
        ]

        def run_command(**given: Any) -> None:
            with opener(**{name: given.pop(name) for name in options}) as opened:
                command(opened, **given)

        parameters = [*own, *shared]
        run_command.__name__, run_command.__doc__ = command.__name__, command.__doc__
        # the attributes of a function that typer reads
        run_command.__annotations__ = {each.name: each.annotation for each in parameters}
        vars(run_command)["__signature__"] = inspect.Signature(parameters)
        return run_command

    return decorate
