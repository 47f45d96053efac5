"""`meshctl init`, `meshctl schema`, `meshctl inventory list|show|state`."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.context import AsJson, InventoryPath
from meshctl.cli.output import echo, echo_json
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.inventory.explain import Why, explain
from meshctl.inventory.json_schema import json_schema
from meshctl.inventory.load import load_fleet
from meshctl.inventory.starter import write_starter
from meshctl.inventory.suggest import did_you_mean
from meshctl.model import Fleet, Node, NodeState, Role

app = typer.Typer(help="Show what the inventory says and why.", no_args_is_help=True)

# Where ssh-keygen puts public keys, the kind that every release but 19.07 knows first.
_PUBLIC_KEYS = ("id_ed25519.pub", "id_ecdsa.pub", "id_rsa.pub")


def init(
    directory: Annotated[Path, typer.Argument(help="Where to write it; made if it does not exist.")],
    ssh_key: Annotated[
        Path | None,
        typer.Option("--ssh-key", help="Your public key; without it the first one in ~/.ssh."),
    ] = None,
) -> None:
    """Write a commented starter inventory. Nothing is overwritten.

    Example: meshctl init my-fleet && meshctl lint my-fleet
    """
    key = _public_key(ssh_key)
    files = write_starter(directory, key)
    for file in files:
        echo(f"wrote {file}")
    if not key:
        echo("no public key was found in ~/.ssh: enter yours as operators.ssh_keys, or nobody may log in", err=True)
    echo(f"next: edit it, then `meshctl lint {directory}`")


def schema(
    out: Annotated[Path | None, typer.Option("--out", help="Write it to this file.")] = None,
) -> None:
    """Print the inventory's JSON Schema, for editors that complete and check.

    Example: meshctl schema --out inventory.schema.json
    """
    text = json.dumps(json_schema(), indent=2) + "\n"
    if out is None:
        echo(text, nl=False)
        return
    try:
        out.write_text(text, encoding="utf-8")
    except OSError as reason:
        raise InputError(f"{out} cannot be written: {reason.strerror}") from reason


@app.command("list")
def list_nodes(
    inventory: InventoryPath = Path(),
    role: Annotated[Role | None, typer.Option("--role", help="Only nodes of this role.")] = None,
    state: Annotated[NodeState | None, typer.Option("--state", help="Only nodes in this state.")] = None,
    robot: Annotated[str, typer.Option("--robot", help="Only nodes that this robot carries.")] = "",
    as_json: AsJson = False,
) -> None:
    """List nodes with role, state, address, mesh and robot.

    Example: meshctl inventory list -i inventory/subt-final --robot husky1 --state carried
    """
    fleet = load_fleet(inventory, environ=os.environ)
    rows = [
        _summary(node)
        for node in fleet.nodes.values()
        if role in (None, node.role) and state in (None, node.state) and robot in ("", node.robot)
    ]
    if as_json:
        echo_json(json.dumps({"fleet": fleet.name, "nodes": rows}, indent=2))
        return
    head = ("NODE", "ROLE", "STATE", "ADDRESS", "HARDWARE", "RELEASE", "MESHES", "ROBOT", "LABEL")
    _table([head, *([_cell(value) for value in row.values()] for row in rows)])


@app.command("show")
def show(
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    inventory: InventoryPath = Path(),
    why: Annotated[bool, typer.Option("--why", help="Tell the layer, file and line of each value.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show everything that holds for one node, and with --why where each value was written.

    Example: meshctl inventory show husky1-b03 --why
    """
    fleet = load_fleet(inventory, environ=os.environ)
    values = explain(fleet, _node(fleet, node))
    if as_json:
        echo_json(json.dumps({"node": node, "values": [_record(value) for value in values]}, indent=2))
        return
    written = [value for value in values if value.value or value.origin.layer != "built-in"]
    echo(node)
    _table([_row(value, why) for value in written], indent="  ")


@app.command("state")
def change_state(
    node: Annotated[str, typer.Argument(help="Name of the node.")],
    new: Annotated[NodeState, typer.Argument(help="Its new state.")],
    inventory: InventoryPath = Path(),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the change and write nothing.")] = False,
) -> None:
    """Write a node's state into the inventory, keeping comments and layout.

    Example: meshctl inventory state husky1-b03 deployed
    """
    fleet = load_fleet(inventory, environ=os.environ)
    _node(fleet, node)
    editor = Editor.open(inventory, environ=os.environ)
    set_state(editor, node, new)
    changes = editor.changes()
    for change in changes:
        echo(change.diff(), nl=False)
    if not dry_run:
        save(changes)


def _public_key(path: Path | None) -> str:
    """The text of a public key: the named file's, or the first usual one's; empty when there is none."""
    candidates = [path] if path is not None else [Path("~/.ssh", name).expanduser() for name in _PUBLIC_KEYS]
    for candidate in candidates:
        if path is None and not candidate.is_file():
            continue
        try:
            text = candidate.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError) as reason:
            raise InputError(f"{candidate} cannot be read as a public key: {reason}") from reason
        if "PRIVATE KEY" in text or len(text.splitlines()) != 1 or not text.startswith(("ssh-", "ecdsa-", "sk-")):
            raise InputError(f"{candidate} is no SSH public key", hint="name the file that ends in .pub")
        return text
    return ""


def _node(fleet: Fleet, name: str) -> Node:
    node = fleet.nodes.get(name)
    if node is None:
        raise InputError(f"the inventory has no node '{name}'", hint=did_you_mean(name, fleet.nodes))
    return node


def _summary(node: Node) -> dict[str, Any]:
    return {
        "name": node.name,
        "role": node.role.value,
        "state": node.state.value,
        "address": str(node.address),
        "hardware": node.hardware.name,
        "release": str(node.release),
        "meshes": list(node.meshes),
        "robot": node.robot,
        "label": node.label,
    }


def _cell(value: Any) -> str:
    return ", ".join(value) if isinstance(value, list) else str(value) or "-"


def _record(value: Why) -> dict[str, Any]:
    place = value.origin.position
    return {
        "key": value.key,
        "value": value.value,
        "layer": value.origin.layer,
        "file": place.file,
        "line": place.line,
        "column": place.column,
    }


def _row(value: Why, why: bool) -> list[str]:
    text = value.value if value.value and value.value.isprintable() else json.dumps(value.value)
    if not why:
        return [value.key, text]
    place = value.origin.position
    return [value.key, text, value.origin.layer, f"{place.file}:{place.line}"]


def _table(rows: Sequence[Sequence[str]], indent: str = "") -> None:
    """Columns as wide as their widest cell."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
        echo((indent + "  ".join(cells)).rstrip())
