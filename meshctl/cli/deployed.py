"""`meshctl deployed`: change beacons from `carried` to `deployed` in the inventory, by name or label.

The edit is that of `meshctl inventory state`: one value per beacon; comments and layout stay.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from meshctl.cli.context import InventoryPath, KeyFiles, Lab, Limit, read_selection
from meshctl.cli.node_completion import complete_nodes
from meshctl.cli.output import echo
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.inventory.load import load_fleet
from meshctl.inventory.selection import LIST_HINT, attributes_of, select
from meshctl.model import Fleet, Node, NodeState, Role


def deployed(
    beacons: Annotated[
        list[str] | None,
        typer.Argument(
            help="Beacons: names, labels, patterns, groups, robot:husky1, '!b07', @FILE.", autocompletion=complete_nodes
        ),
    ] = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    back: Annotated[bool, typer.Option("--back", help="Mark as carried again, after pick-up.")] = False,
    from_mesh: Annotated[
        bool,
        typer.Option(
            "--from-mesh", help="Query the mesh, and mark the carried beacons that are away from their robot."
        ),
    ] = False,
    watch: Annotated[
        float | None,
        typer.Option(
            "--watch",
            min=1.0,
            metavar="S",
            help="As --from-mesh every S seconds until Ctrl-C; marks what two queries in a row show.",
        ),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the change without writing it.")] = False,
    key: KeyFiles = None,
    lab: Lab = None,
) -> None:
    """Mark dropped beacons as deployed; `meshctl status` then expects them to answer.

    Example: meshctl deployed husky1-b03 B4

    Example: meshctl deployed --from-mesh

    Example: meshctl deployed --watch 30
    """
    for other, is_set in (("--from-mesh", from_mesh), ("--watch", watch is not None)):
        if back and is_set:
            raise InputError(f"expected --back or {other}, found both")
    if watch is not None:
        _watch(inventory, key, lab, watch, beacons, limit, dry_run=dry_run)
    if not beacons and not from_mesh:
        raise InputError("expected beacons, or --from-mesh", hint="for example: meshctl deployed husky1-b03")
    fleet = load_fleet(inventory, environ=os.environ)
    before, after = (NodeState.DEPLOYED, NodeState.CARRIED) if back else (NodeState.CARRIED, NodeState.DEPLOYED)
    chosen = chosen_beacons(fleet, beacons or ["role:beacon"], limit or ())
    if from_mesh:
        found = _found_in_mesh(inventory, key, lab, chosen)
        chosen = [node for node in chosen if node.name in found]
        for node in chosen:
            echo(f"{node.name}: {found[node.name]}", err=True)
        if not chosen:
            echo("no carried beacon appears to have been dropped", err=True)
            return
    wrong = [node for node in chosen if node.state not in (before, after)]
    if wrong:
        states = ", ".join(f"{node.name} is {node.state.value}" for node in wrong)
        raise InputError(
            f"expected {before.value} beacons, found: {states}",
            hint=f"to set any state, run `meshctl inventory state {wrong[0].name} {after.value}`",
        )
    _mark(inventory, chosen, before, after, dry_run=dry_run)


def _mark(inventory: Path, chosen: Iterable[Node], before: NodeState, after: NodeState, *, dry_run: bool) -> None:
    """Edit the inventory and show the change; those with the state `after` already are reported."""
    editor = Editor.open(inventory, environ=os.environ)
    for node in chosen:
        if node.state is before:
            set_state(editor, node.name, after)
    changes = editor.changes()
    for change in changes:
        echo(change.diff(), nl=False)
    for node in chosen:
        if node.state is after:
            echo(f"{node.name}: already {after.value}")
    if not dry_run:
        save(changes)


def _found_in_mesh(inventory: Path, key: list[Path] | None, lab: Path | None, chosen: Iterable[Node]) -> dict[str, str]:
    """The dropped beacons that one snapshot of the mesh shows, each with the reason."""
    from meshctl.cli.deployed_watch import dropped_in
    from meshctl.cli.fleet_view import open_fleet_view

    with open_fleet_view(inventory, key=key, lab=lab, no_robots=True) as fleet_view:
        return dropped_in(fleet_view, chosen)


def _watch(
    inventory: Path,
    key: list[Path] | None,
    lab: Path | None,
    period_s: float,
    beacons: list[str] | None,
    limit: list[str] | None,
    *,
    dry_run: bool,
) -> NoReturn:
    """Mark dropped beacons by themselves, until Ctrl-C."""
    from meshctl.cli.deployed_watch import watch_for_drops
    from meshctl.cli.fleet_view import open_fleet_view

    def choose(fleet: Fleet) -> list[Node]:
        return chosen_beacons(fleet, beacons or ["role:beacon"], limit or ())

    def mark(nodes: list[Node]) -> None:
        _mark(inventory, nodes, NodeState.CARRIED, NodeState.DEPLOYED, dry_run=dry_run)

    echo(f"watching the mesh every {period_s:g} s; Ctrl-C to end", err=True)
    watch_for_drops(partial(open_fleet_view, inventory, key=key, lab=lab, no_robots=True), choose, mark, period_s)


def chosen_beacons(fleet: Fleet, words: Iterable[str], limits: Iterable[str] = ()) -> list[Node]:
    """The beacons that the words select. Raises InputError for no match, an ambiguous label, or another radio."""
    wanted = tuple(words)
    for word in wanted:
        node = fleet.nodes.get(word)
        if node is not None and node.role is not Role.BEACON:
            raise InputError(
                f"{node.name} is not a beacon: its role is {node.role.value}",
                hint=f"for any node: meshctl inventory state {node.name} deployed",
            )
        labeled = [node.name for node in fleet.managed() if node.label and node.label.lower() == word.lower()]
        if len(labeled) > 1:
            raise InputError(f"label '{word}' is ambiguous: {', '.join(labeled)}")
    # a word names unmanaged beacons too, which are refused with their state
    beacons = [
        node
        for node in fleet.nodes.values()
        if node.role is Role.BEACON and (node.state.is_managed or node.name in wanted)
    ]
    candidates = {node.name: attributes_of(node) for node in beacons}
    names = select(wanted, candidates, read_selection, limits, what="beacon", hint=LIST_HINT)
    return [fleet.nodes[name] for name in names]
