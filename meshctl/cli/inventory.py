"""`meshctl init`, `meshctl schema`, `meshctl inventory`."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from meshctl.cli.command_group import ImportGroup
from meshctl.cli.context import AsJson, InventoryPath, Limit, Nodes, OneNode, selected_node, selected_nodes
from meshctl.cli.export import export
from meshctl.cli.inventory_import import app as import_app
from meshctl.cli.output import echo, echo_json, terminal_width, write_file
from meshctl.cli.public_key import own_public_key
from meshctl.errors import InputError
from meshctl.inventory.edit import Editor, save, set_state
from meshctl.inventory.explain import ExplainedValue, explain
from meshctl.inventory.json_schema import json_schema
from meshctl.inventory.load import load_fleet
from meshctl.inventory.starter import write_starter
from meshctl.model import Node, NodeState, Role
from meshctl.report import text_table
from meshctl.report.line_wrap import wrap

_GAP = "  "
# the columns of `list` that a narrow terminal leaves out, in this order; those without any value first
_LEAVE_OUT = ("LABEL", "RELEASE", "HARDWARE", "MESHES", "ROBOT", "ADDRESS")

app = typer.Typer(help="Show and edit the inventory.", no_args_is_help=True)
app.command("export")(export)
app.add_typer(import_app, name="import", cls=ImportGroup, no_args_is_help=True)


def init(
    directory: Annotated[Path, typer.Argument(help="Directory to write to; created if missing.")],
    ssh_key: Annotated[
        Path | None,
        typer.Option("--ssh-key", help="Your SSH public key; default: the first one in ~/.ssh."),
    ] = None,
) -> None:
    """Create a commented starter inventory. Existing files are never overwritten.

    Example: meshctl init my-fleet && meshctl lint my-fleet
    """
    key = own_public_key(ssh_key)
    files = write_starter(directory, key)
    for file in files:
        echo(f"wrote {file}")
    if not key:
        echo("no public key in ~/.ssh: add yours to operators.ssh_keys, or you cannot log in to the nodes", err=True)
    echo(f"next: edit it, then run `meshctl lint {directory}`")


def schema(
    out: Annotated[Path | None, typer.Option("--out", help="Write to this file.")] = None,
) -> None:
    """Print the JSON Schema of the inventory, for completion and validation in editors.

    Example: meshctl schema --out inventory.schema.json
    """
    if out is not None and out.suffix in (".yaml", ".yml"):
        # what it would overwrite is an inventory
        raise InputError(f"--out: expected a file name that does not end in {out.suffix}, found {out}")
    text = json.dumps(json_schema(), indent=2) + "\n"
    if out is None:
        echo(text, nl=False)
    else:
        write_file(out, text)


@app.command("list")
def list_nodes(
    nodes: Nodes = None,
    limit: Limit = None,
    inventory: InventoryPath = Path(),
    role: Annotated[Role | None, typer.Option("--role", help="Only nodes with this role.")] = None,
    state: Annotated[NodeState | None, typer.Option("--state", help="Only nodes in this state.")] = None,
    robot: Annotated[str, typer.Option("--robot", help="Only nodes on this robot.")] = "",
    as_json: AsJson = False,
) -> None:
    """List nodes with role, state, address, mesh and robot, including lost and retired ones.

    Example: meshctl inventory list robot:husky1 --state carried
    """
    fleet = load_fleet(inventory, environ=os.environ)
    rows = [
        _summary(node)
        for node in selected_nodes(fleet, nodes, limit, with_unmanaged=True)
        if role in (None, node.role) and state in (None, node.state) and robot in ("", node.robot)
    ]
    if as_json:
        echo_json(json.dumps({"fleet": fleet.name, "nodes": rows}, indent=2))
        return
    head = ("NODE", "ROLE", "STATE", "ADDRESS", "HARDWARE", "RELEASE", "MESHES", "ROBOT", "LABEL")
    cells = [[_cell(value) for value in row.values()] for row in rows]
    for line in text_table.lines(head, cells, terminal_width(sys.stdout), leave_out=_LEAVE_OUT):
        echo(line)


@app.command("show")
def show(
    node: OneNode,
    inventory: InventoryPath = Path(),
    why: Annotated[bool, typer.Option("--why", help="Show the layer, file and line of each value.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show all values of one node; with --why, where each is defined.

    Example: meshctl inventory show husky1-b03 --why
    """
    fleet = load_fleet(inventory, environ=os.environ)
    name = selected_node(fleet, node, with_unmanaged=True).name
    values = explain(fleet, fleet.nodes[name])
    if as_json:
        echo_json(json.dumps({"node": name, "values": [_record(value) for value in values]}, indent=2))
        return
    written = [value for value in values if value.value or value.origin.layer != "built-in"]
    echo(name)
    for line in _value_lines([_row(value, why) for value in written], terminal_width(sys.stdout)):
        echo(line)


@app.command("state")
def change_state(
    node: OneNode,
    new: Annotated[NodeState, typer.Argument(help="New state.")],
    inventory: InventoryPath = Path(),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the change without writing it.")] = False,
) -> None:
    """Set a node's state in the inventory, keeping comments and layout.

    Example: meshctl inventory state husky1-b03 deployed
    """
    fleet = load_fleet(inventory, environ=os.environ)
    name = selected_node(fleet, node, with_unmanaged=True).name
    editor = Editor.open(inventory, environ=os.environ)
    set_state(editor, name, new)
    changes = editor.changes()
    for change in changes:
        echo(change.diff(), nl=False)
    if not dry_run:
        save(changes)


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


def _record(value: ExplainedValue) -> dict[str, Any]:
    place = value.origin.position
    return {
        "key": value.key,
        "value": value.value,
        "layer": value.origin.layer,
        "file": place.file,
        "line": place.line,
        "column": place.column,
    }


def _row(value: ExplainedValue, why: bool) -> list[str]:
    text = value.value if value.value and value.value.isprintable() else json.dumps(value.value)
    if not why:
        return [value.key, text]
    place = value.origin.position
    return [value.key, text, value.origin.layer, f"{place.file}:{place.line}"]


def _value_lines(rows: Sequence[Sequence[str]], width: int | None) -> list[str]:
    """Rows with aligned columns; if they do not fit into `width`, what follows a value is below it."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    cells = ([cell.ljust(room) for cell, room in zip(row, widths, strict=True)] for row in rows)
    lines = [f"  {_GAP.join(line)}".rstrip() for line in cells]
    if width is None or max(map(len, lines)) <= width:
        return lines
    folded = []
    for row in rows:
        key, value, *places = (row[0].ljust(widths[0]), *row[1:])
        folded += wrap(f"  {key}{_GAP}{value}", width)
        folded += wrap(f"    {_GAP.join(places)}", width) if places else []
    return folded
