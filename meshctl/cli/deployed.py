"""`meshctl deployed`: change beacons from `carried` to `deployed` in the inventory, by name or label.

The edit is that of `meshctl inventory state`: one value per beacon; comments and layout stay.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import InventoryPath
from meshctl.cli.output import echo
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.inventory.load import load_fleet
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Node, NodeState, Role


def deployed(
    beacons: Annotated[list[str], typer.Argument(help="Beacons by name, label, or pattern such as 'h1-b0*'.")],
    inventory: InventoryPath = Path(),
    back: Annotated[bool, typer.Option("--back", help="Mark as carried again, after pick-up.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the change without writing it.")] = False,
) -> None:
    """Mark dropped beacons as deployed; `meshctl status` then expects them to answer.

    Example: meshctl deployed husky1-b03 B4
    """
    fleet = load_fleet(inventory, environ=os.environ)
    before, after = (NodeState.DEPLOYED, NodeState.CARRIED) if back else (NodeState.CARRIED, NodeState.DEPLOYED)
    chosen = chosen_beacons(fleet, beacons)
    wrong = [node for node in chosen if node.state not in (before, after)]
    if wrong:
        states = ", ".join(f"{node.name} is {node.state.value}" for node in wrong)
        raise InputError(
            f"expected {before.value} beacons, found: {states}",
            hint=f"to set any state, run `meshctl inventory state {wrong[0].name} {after.value}`",
        )
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


def chosen_beacons(fleet: Fleet, words: Iterable[str]) -> list[Node]:
    """The beacons that the words select, each once. Raises InputError for no match, or for another radio."""
    chosen: dict[str, Node] = {}
    for word in words:
        named = [fleet.nodes[word]] if word in fleet.nodes else _labeled(fleet, word) or _matching(fleet, word)
        if not named:
            names = (*fleet.nodes, *(node.label for node in fleet.nodes.values() if node.label))
            raise InputError(f"no beacon has the name or label '{word}'", hint=did_you_mean(word, names))
        if named[0].role is not Role.BEACON:
            raise InputError(f"{named[0].name} is not a beacon: its role is {named[0].role.value}")
        chosen |= {node.name: node for node in named}
    return list(chosen.values())


def _labeled(fleet: Fleet, word: str) -> list[Node]:
    """Case-insensitive; labels of managed nodes are unique (MC116)."""
    found = [node for node in fleet.managed() if node.label and node.label.lower() == word.lower()]
    if len(found) > 1:
        raise InputError(f"label '{word}' is ambiguous: {', '.join(node.name for node in found)}")
    return found


def _matching(fleet: Fleet, pattern: str) -> list[Node]:
    return [node for node in fleet.managed() if node.role is Role.BEACON and fnmatchcase(node.name, pattern)]
