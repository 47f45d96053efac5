"""`meshctl inventory import`: nodes from a CSV table, existing devices, recorded configurations and NetBox."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from meshctl.cli.context import AsJson, DryRun, InventoryPath
from meshctl.cli.device_import import import_device, import_export
from meshctl.cli.input_file import read_input
from meshctl.cli.new_nodes_file import NewNodesFile, file_of_new_nodes
from meshctl.cli.output import echo, echo_json
from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.inventory.csv_table import COLUMNS, NodeEdit, Row, at_row, checked, edits, read
from meshctl.inventory.edit import Editor, FileEdit, save
from meshctl.inventory.load import load_fleet
from meshctl.model import Fleet
from meshctl.suggest import did_you_mean
from meshctl.wording import counted

app = typer.Typer(help="Import nodes from a CSV table (the default), an existing device, its `uci export`, or NetBox.")


@app.command("csv")
def import_table(
    table: Annotated[str, typer.Argument(metavar="FILE", help="CSV file with a header; - for standard input.")],
    inventory: InventoryPath = Path(),
    add: Annotated[bool, typer.Option("--add", help="Add nodes that the inventory does not have.")] = False,
    file: NewNodesFile = None,
    column: Annotated[
        list[str] | None,
        typer.Option("--column", metavar="COLUMN=HEADING", help="Read a column under another heading."),
    ] = None,
    ignore: Annotated[
        list[str] | None, typer.Option("--ignore", metavar="HEADING", help="Skip the column with this heading.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the change without writing it.")] = False,
    as_json: AsJson = False,
) -> None:
    """Set labels, serial numbers, MAC addresses and other values of nodes from a CSV table.

    Columns: node, label, serial, mac, role, state, hardware, release, address, robot, site, groups (names separated by
    blanks). A row names its node in `node`, or else by its label. Empty cells change nothing; the inventory's comments
    and layout stay.

    Example: meshctl inventory import csv boxes.csv --column "mac=MAC address" --ignore Owner --dry-run
    """
    fleet = load_fleet(inventory, environ=os.environ)
    source = read_input(table)
    rows = read(source.text, source.file, headings=_headings(column or ()), ignored=ignore or ())
    _take_over(inventory, fleet, rows, source.file, add=add, new_in=file, dry_run=dry_run, as_json=as_json)


@app.command("netbox")
def import_netbox(
    url: Annotated[str, typer.Argument(metavar="URL", help="Address of NetBox, e.g. https://netbox.example.org.")],
    inventory: InventoryPath = Path(),
    query: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="KEY=VALUE", help="Only devices that match, e.g. site=lab; repeatable."),
    ] = None,
    add: Annotated[bool, typer.Option("--add", help="Add nodes that the inventory does not have.")] = False,
    file: NewNodesFile = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
) -> None:
    """Import the names, asset tags, serial numbers, MAC and primary addresses of NetBox's devices.

    The API token is in $NETBOX_TOKEN. Needs pynetbox, the extra `netbox`.

    Example: NETBOX_TOKEN=... meshctl inventory import netbox https://netbox.example.org --filter site=mine --add
    """
    from meshctl.cli.netbox_client import fetch
    from meshctl.interchange.netbox import rows as netbox_rows

    fleet = load_fleet(inventory, environ=os.environ)
    devices, interfaces = fetch(url, os.environ.get("NETBOX_TOKEN", ""), _filters(query or ()))
    if not devices:
        # as for every other selection: nothing is usually a typo
        asked = f" matches {' '.join(f'--filter {word}' for word in query)}" if query else ""
        raise InputError(f"{url}: no device{asked}", hint="see the list of devices in NetBox")
    unnamed = sum(not device.get("name") for device in devices)
    if unnamed:
        echo(f"left out: {counted(unnamed, 'device')} without a name in NetBox", err=True)
    place = f"{url.rstrip('/')}/dcim/devices"
    found = checked(netbox_rows(devices, interfaces, fleet), place)
    _take_over(inventory, fleet, found, place, add=add, new_in=file, dry_run=dry_run, as_json=as_json)


def _filters(words: Sequence[str]) -> dict[str, list[str]]:
    """The query's parameters, each with all its values."""
    filters: dict[str, list[str]] = {}
    for word in words:
        key, separator, value = word.partition("=")
        if not separator or not key or not value:
            raise InputError(f"--filter {word}: expected KEY=VALUE, such as site=lab")
        filters.setdefault(key, []).append(value)
    return filters


app.command("device")(import_device)
app.command("uci")(import_export)


def _take_over(
    inventory: Path,
    fleet: Fleet,
    rows: tuple[Row, ...],
    file: str,
    *,
    add: bool,
    new_in: Path | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Show and write what the rows change in the inventory."""
    found = edits(rows, fleet, file, add=add)
    editor = Editor.open(inventory, environ=os.environ)
    if any(each.is_new for each in found):
        editor.new_nodes_file = file_of_new_nodes(editor, new_in)
    changes = _changes(editor, found, file)
    if as_json:
        nodes = [{"node": each.node, "line": each.line, "new": each.is_new, "values": each.values} for each in found]
        echo_json(json.dumps({"fleet": fleet.name, "rows": len(rows), "nodes": nodes}, indent=2))
    else:
        for change in changes:
            echo(change.diff(), nl=False)
        new = sum(each.is_new for each in found)
        where = f" in {editor.new_nodes_file}" if new else ""
        echo(
            f"{counted(len(rows), 'row')}: {counted(len(found) - new, 'node')} to change, {new} to add{where}", err=True
        )
    if not dry_run:
        save(changes)


def _changes(editor: Editor, found: tuple[NodeEdit, ...], file: str) -> tuple[FileEdit, ...]:
    editor.set_nodes({each.node: each.values for each in found})
    try:
        return editor.changes()
    except InvalidInput as reason:
        of_rows = [at_row(diagnostic, found, file) for diagnostic in reason.diagnostics]
        if None not in of_rows:
            raise InvalidInput(filter(None, of_rows)) from reason
        raise InputError(f"{file}: the inventory would have errors, so nothing was written:\n{reason}") from reason


def _headings(words: list[str] | tuple[str, ...]) -> dict[str, str]:
    """Heading -> column, from words such as `mac=MAC address`."""
    headings: dict[str, str] = {}
    for word in words:
        name, separator, heading = word.partition("=")
        if not separator or not heading.strip():
            raise InputError(f"--column {word}: expected COLUMN=HEADING, found {word}")
        if name not in COLUMNS:
            hint = did_you_mean(name, COLUMNS) or f"columns: {', '.join(COLUMNS)}"
            raise InputError(f"--column {word}: there is no column '{name}'", hint=hint)
        headings[heading] = name
    return headings
