"""Nodes as a CSV table, for spreadsheets, stocktaking and label printers. Pure.

Out: `write` makes one row per node. In: `read` checks the table and every value, `edits` compares it with the inventory
and returns what to set on each node; an empty cell leaves the inventory's value. A cell of `groups` has names separated
by blanks.
"""

from __future__ import annotations

import csv
import io
import re
import unicodedata
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

from pydantic import TypeAdapter, ValidationError

from meshctl.diagnostics import Diagnostic, InvalidInput, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import printable
from meshctl.inventory.documents.node import NodeDocument
from meshctl.inventory.fields import Name
from meshctl.inventory.tree import Plain
from meshctl.inventory.validate import allowed_values, expected_value
from meshctl.inventory.yaml_text import Value
from meshctl.model import Fleet, Node, NodeState
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

NODE = "node"
_GETTERS: Mapping[str, Callable[[Node], str]] = {
    "label": lambda node: node.label,
    "serial": lambda node: node.serial,
    "mac": lambda node: node.mac,
    "role": lambda node: node.role.value,
    "state": lambda node: node.state.value,
    "hardware": lambda node: node.hardware.name,
    "release": lambda node: node.release.value,
    "address": lambda node: str(node.address.ip),
    "robot": lambda node: node.robot,
    "site": lambda node: node.site,
    "groups": lambda node: " ".join(node.groups),
}
COLUMNS = (NODE, *_GETTERS)
_LISTS = ("groups",)
# an error of Python's reader, for a cell that begins with a quotation mark and extends to the end of the file
_UNCLOSED = "unexpected end of data"
# no two devices have the same one
_IDENTIFIERS = ("label", "serial", "mac")
_UNIQUE = (NODE, *_IDENTIFIERS)
# headings of spreadsheets and of other programs' exports, and the columns that they mean
_OTHER_HEADINGS = {
    "name": NODE,
    "device": NODE,
    "device_name": NODE,
    "host": NODE,
    "hostname": NODE,
    "node_name": NODE,
    "asset_tag": "label",
    "sticker": "label",
    "serial_no": "serial",
    "serial_number": "serial",
    "s/n": "serial",
    "sn": "serial",
    "hardware_address": "mac",
    "mac_addr": "mac",
    "mac_address": "mac",
    "status": "state",
    "model": "hardware",
    "device_type": "hardware",
    "openwrt": "release",
    "firmware": "release",
    "ip": "address",
    "ip_address": "address",
    "ipv4_address": "address",
    "location": "site",
}
_DELIMITERS = ",;\t"
# MAC addresses as inventories, labels, barcodes and switches write them
_MAC = re.compile(r"[0-9a-f]{2}(?:[:-]?[0-9a-f]{2}){5}|[0-9a-f]{4}(?:\.[0-9a-f]{4}){2}", re.IGNORECASE)
# a formula, the error of one, and a number of many digits as spreadsheets shorten it
_FORMULA = re.compile(r"=.*|#(?:REF!|N/A|NAME\?|VALUE!|DIV/0!|NULL!|NUM!)")
_SHORTENED = re.compile(r"\d(?:[.,]\d+)?E\+\d+")


@dataclass(frozen=True, slots=True)
class Row:
    """One node of a table: `line` counts from 1, `values` has the cells that are not empty, by column."""

    line: int
    values: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class NodeEdit:
    """The values that a row sets on a node; `is_new` for a node that the inventory does not have."""

    node: str
    line: int
    is_new: bool
    values: Mapping[str, Value]


def write(nodes: Iterable[Node]) -> str:
    """The table of these nodes, with a header (RFC 4180, but lines end with LF)."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(COLUMNS)
    writer.writerows([node.name, *(get(node) for get in _GETTERS.values())] for node in nodes)
    return out.getvalue()


def read(
    text: str, file: str, *, headings: Mapping[str, str] | None = None, ignored: Collection[str] = ()
) -> tuple[Row, ...]:
    """The rows of a table separated by commas, semicolons or tabs.

    `headings` maps headings of the table to columns, `ignored` are headings to skip. Raises InvalidInput with all
    errors.
    """
    lines = _records(text, file)
    number, header = next(lines, (1, []))
    columns = _columns(header, Position(file, number), headings or {}, ignored)
    rows: list[Row] = []
    errors: list[Diagnostic] = []
    for number, cells in lines:
        place = Position(file, number)
        if extra := [cell for cell in cells[len(columns) :] if cell.strip()]:
            errors.append(
                _wrong(place, "", f"{len(columns)} cells, as in the header", f"'{printable(extra[0])}' beyond")
            )
            continue
        pairs = zip(columns, map(str.strip, cells), strict=False)
        values = {column: _normalized(column, cell) for column, cell in pairs if column and cell}
        if values:
            errors += _errors_of(values, place)
            rows.append(Row(number, values))
    errors += _repeated(rows, file)
    if errors:
        raise InvalidInput(errors[: codes.MAX_DIAGNOSTICS])
    return tuple(rows)


def checked(rows: Iterable[Row], file: str) -> tuple[Row, ...]:
    """Rows from elsewhere, whose values are those that the inventory allows. Raises InvalidInput with all errors."""
    found = tuple(rows)
    errors = [error for row in found for error in _errors_of(row.values, Position(file, row.line))]
    errors += _repeated(found, file)
    if errors:
        raise InvalidInput(errors[: codes.MAX_DIAGNOSTICS])
    return found


def edits(rows: Iterable[Row], fleet: Fleet, file: str, *, add: bool = False) -> tuple[NodeEdit, ...]:
    """The edits of each node that differs from the inventory. A row names its node by `node`, else by `label`.

    `add` allows nodes that the inventory does not have. Raises InvalidInput with all rows that name no node.
    """
    by_label = {node.label.lower(): node for node in fleet.nodes.values() if node.label}
    found: list[NodeEdit] = []
    errors: list[Diagnostic] = []
    for row in rows:
        name, label = row.values.get(NODE, ""), row.values.get("label", "")
        node = fleet.nodes.get(name) if name else by_label.get(label.lower())
        values = {key: value for key, value in row.values.items() if key != NODE}
        place = Position(file, row.line)
        if node is not None:
            changed = {key: value for key, value in values.items() if not _has(node, key, value)}
            if changed:
                found.append(NodeEdit(node.name, row.line, False, _parsed(changed)))
        elif not (name or label):
            errors.append(_wrong(place, NODE, "a name or a label", "neither"))
        elif name and add:
            found.append(NodeEdit(name, row.line, True, _parsed(values)))
        else:
            key, word, known = (NODE, name, list(fleet.nodes)) if name else ("label", label, list(by_label))
            hint = did_you_mean(word, known) or (
                "give --add to add new nodes" if name else "new nodes need a column 'node'"
            )
            errors.append(_wrong(place, key, "a node of the inventory", f"'{printable(word)}'", hint))
    errors += _unknown_or_taken(found, fleet, file)
    if errors:
        raise InvalidInput(errors[: codes.MAX_DIAGNOSTICS])
    return tuple(found)


def at_row(diagnostic: Diagnostic, found: Iterable[NodeEdit], file: str) -> Diagnostic | None:
    """An error of the edited inventory, such as an unknown group, at the row that set the value; None if none did."""
    for edit in found:
        for column in edit.values:
            if diagnostic.path == f"nodes.{edit.node}.{column}":
                return replace(diagnostic, position=Position(file, edit.line), path=column)
    return None


def _has(node: Node, column: str, value: str) -> bool:
    """Whether the node has this value already; an address may have its prefix length."""
    return value == _GETTERS[column](node) or (column == "address" and value == str(node.address))


def _unknown_or_taken(found: Iterable[NodeEdit], fleet: Fleet, file: str) -> Iterator[Diagnostic]:
    """Names that the inventory does not have, and identifiers and addresses that another node has after these edits."""
    edited = {edit.node: edit for edit in found}
    owners: dict[tuple[str, str], str] = {}
    named: Mapping[str, tuple[str, Collection[str]]] = {
        "site": ("site", fleet.sites),
        "robot": ("robot", fleet.robots),
        "hardware": ("hardware profile", fleet.hardware),
    }
    for node in fleet.nodes.values():
        values = edited[node.name].values if node.name in edited else {}
        for column in _IDENTIFIERS:
            text = _GETTERS[column](node)
            if text and column not in values and node.state is not NodeState.RETIRED:
                owners[column, text.lower()] = node.name
    for edit in edited.values():
        place = Position(file, edit.line)
        for column, (kind, known) in named.items():
            name = str(edit.values.get(column, ""))
            if name and name not in known:
                expected = f"a {kind} of the inventory ({join_limited(list(known))})" if known else f"no {kind}"
                yield _wrong(place, column, expected, f"'{printable(name)}'", did_you_mean(name, known))
        for column in _IDENTIFIERS:
            owner = owners.get((column, str(edit.values.get(column, "")).lower()))
            if owner is not None:
                text = printable(str(edit.values[column]))
                yield _wrong(place, column, "a value of one device", f"'{text}', which node {owner} has")
    yield from _taken_addresses(edited, fleet, file)


def _taken_addresses(edited: Mapping[str, NodeEdit], fleet: Fleet, file: str) -> Iterator[Diagnostic]:
    """Addresses that another managed node has after these edits; those of lost and retired nodes are free."""
    owners = {
        str(node.address.ip): node.name
        for node in fleet.managed()
        if node.name not in edited or not {"address", "state"} & set(edited[node.name].values)
    }
    for edit in edited.values():
        if not {"address", "state"} & set(edit.values):
            continue
        node = fleet.nodes.get(edit.node)
        state = str(edit.values.get("state") or (NodeState.DEPLOYED if node is None else node.state).value)
        own = "" if node is None else str(node.address.ip)
        address = str(edit.values.get("address", own)).partition("/")[0]
        if not address or not NodeState(state).is_managed:
            continue
        owner = owners.setdefault(address, edit.node)
        if owner != edit.node:
            found = f"'{printable(address)}', which node {owner} has"
            yield _wrong(Position(file, edit.line), "address", "an address of one node", found)


def _records(text: str, file: str) -> Iterator[tuple[int, list[str]]]:
    """Each record with the line on which it starts, without empty ones."""
    first, newline, rest = text.partition("\n")
    # Excel writes and reads a line that names the delimiter
    named = re.fullmatch(r"sep=([,;\t])\r?", first, re.IGNORECASE)
    content = rest if named and newline else text
    delimiter = named[1] if named else max(_DELIMITERS, key=first.count)
    reader = csv.reader(io.StringIO(content, newline=""), delimiter=delimiter, strict=True)
    while True:
        line = reader.line_num + (2 if named else 1)
        try:
            cells = next(reader, None)
        except csv.Error as reason:
            found = "a quotation mark without its end" if str(reason) == _UNCLOSED else str(reason)
            raise InvalidInput([_wrong(Position(file, line), "", "CSV", found)]) from None
        if cells is None:
            return
        if any(cell.strip() for cell in cells):
            yield line, cells


def _columns(
    header: Sequence[str], place: Position, headings: Mapping[str, str], ignored: Collection[str]
) -> tuple[str, ...]:
    """The column of each cell; empty for ignored ones."""
    columns: list[str] = []
    errors: list[Diagnostic] = []
    skipped = {heading.strip().lower() for heading in ignored}
    mapped = {heading.strip().lower(): column for heading, column in headings.items()}
    for cell in header:
        heading = cell.strip().lower()
        column = mapped.get(heading, heading.replace(" ", "_"))
        if heading in skipped or not heading:
            columns.append("")
        elif column not in COLUMNS:
            written = printable(cell.strip())
            errors.append(
                _wrong(place, "", f"a column of {', '.join(COLUMNS)}", f"'{written}'", _heading_hint(column, written))
            )
        elif column in columns:
            errors.append(_wrong(place, column, "one column", "two"))
        else:
            columns.append(column)
    if not {NODE, "label"} & set(columns):
        written = ", ".join(f"'{printable(cell.strip())}'" for cell in header if cell.strip())
        hint = "the first line is the header; --column node=HEADING or label=HEADING names the column of the nodes"
        expected = "a header with a column 'node' or 'label'"
        if not any(columns):
            # a title above the table, or no table
            errors = []
        errors.append(_wrong(place, "", expected, written or "none", hint if written else ""))
    if errors:
        raise InvalidInput(errors)
    return tuple(columns)


def _heading_hint(column: str, written: str) -> str:
    meant = _OTHER_HEADINGS.get(column, "")
    if meant:
        return f"""read it with --column "{meant}={written}", or skip it with --ignore "{written}\""""
    similar = did_you_mean(column, COLUMNS)
    ways = "map it with --column COLUMN=HEADING, or skip it with --ignore HEADING"
    return f"{similar} If not, {ways}" if similar else ways


def _normalized(column: str, cell: str) -> str:
    if column in _LISTS:
        return " ".join(cell.split())
    if column == "mac" and _MAC.fullmatch(cell):
        digits = re.sub("[:.-]", "", cell).lower()
        return ":".join(digits[at : at + 2] for at in range(0, len(digits), 2))
    return cell


def _parsed(values: Mapping[str, str]) -> dict[str, Value]:
    """The values as the inventory has them."""
    return {column: value.split() if column in _LISTS else value for column, value in values.items()}


def _errors_of(values: Mapping[str, str], place: Position) -> Iterator[Diagnostic]:
    """Errors of a row's values by the inventory's format."""
    for column, value in values.items():
        if odd := _not_as_on_the_device(value):
            yield _wrong(place, column, "the text that is on the device", *odd)
            continue
        try:
            if column == NODE:
                TypeAdapter(Name).validate_python(Plain(value))
            else:
                parts: object = [Plain(part) for part in value.split()] if column in _LISTS else Plain(value)
                NodeDocument.model_validate({column: parts})
        except ValidationError as reason:
            (error, *_) = reason.errors(include_url=False, include_input=False)
            hint = did_you_mean(value, allowed_values(error))
            yield _wrong(place, column, expected_value(error), f"'{printable(value)}'", hint)


def _not_as_on_the_device(value: str) -> tuple[str, str] | None:
    """How a spreadsheet or a copied page has changed a value, and the remedy; None if the value may be unchanged."""
    shown = f"'{printable(value)}'"
    if _FORMULA.fullmatch(value):
        return f"{shown}, a formula or its error", "save the sheet with values instead of formulas"
    if _SHORTENED.fullmatch(value):
        return f"{shown}, a number that a spreadsheet shortened", "make the column text, and enter the value again"
    if hidden := next((each for each in value if unicodedata.category(each) == "Cf"), ""):
        return f"{shown} with the invisible character U+{ord(hidden):04X}", "type the value instead of copying it"
    return None


def _repeated(rows: Iterable[Row], file: str) -> Iterator[Diagnostic]:
    """Values of two rows that only one device can have."""
    lines: dict[tuple[str, str], int] = {}
    for row in rows:
        for column in _UNIQUE:
            value = row.values.get(column, "")
            first = lines.setdefault((column, value.lower()), row.line) if value else row.line
            if first != row.line:
                found = f"'{printable(value)}', which line {first} has too"
                yield _wrong(Position(file, row.line), column, "a value of one device", found)


def _wrong(place: Position, column: str, expected: str, found: str, hint: str = "") -> Diagnostic:
    return codes.error(codes.CSV_TABLE, place, "", path=column, expected=expected, found=found, hint=hint)
