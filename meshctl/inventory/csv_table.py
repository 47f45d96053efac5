"""Nodes as a CSV table, for spreadsheets, stocktaking and label printers. Pure.

Out: `write` makes one row per node. In: `read` checks the table and every value, `edits` compares it with the inventory
and returns what to set on each node; an empty cell leaves the inventory's value. A cell of `groups` has names separated
by blanks.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from pydantic import TypeAdapter, ValidationError

from meshctl.diagnostics import Diagnostic, InvalidInput, Position
from meshctl.inventory import codes
from meshctl.inventory.compose import printable
from meshctl.inventory.documents.node import NodeDocument
from meshctl.inventory.fields import Name
from meshctl.inventory.suggest import did_you_mean
from meshctl.inventory.tree import Plain
from meshctl.inventory.validate import expected_value
from meshctl.inventory.yaml_text import Value
from meshctl.model import Fleet, Node

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
# no two devices have the same one
_UNIQUE = (NODE, "label", "serial", "mac")
_DELIMITERS = ",;\t"


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
            changed = {key: value for key, value in values.items() if value != _GETTERS[key](node)}
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
    if errors:
        raise InvalidInput(errors)
    return tuple(found)


def _records(text: str, file: str) -> Iterator[tuple[int, list[str]]]:
    """Each record with the line on which it starts, without empty ones."""
    first = text.partition("\n")[0]
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(_DELIMITERS, key=first.count), strict=True)
    while True:
        line = reader.line_num + 1
        try:
            cells = next(reader, None)
        except csv.Error as reason:
            raise InvalidInput([_wrong(Position(file, line), "", "CSV", str(reason))]) from None
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
            hint = (
                did_you_mean(column, COLUMNS) or "map it with --column COLUMN=HEADING, or skip it with --ignore HEADING"
            )
            errors.append(_wrong(place, "", f"a column of {', '.join(COLUMNS)}", f"'{printable(cell.strip())}'", hint))
        elif column in columns:
            errors.append(_wrong(place, column, "one column", "two"))
        else:
            columns.append(column)
    if not errors and not {NODE, "label"} & set(columns):
        errors.append(_wrong(place, "", "a header with a column 'node' or 'label'", "none"))
    if errors:
        raise InvalidInput(errors)
    return tuple(columns)


def _normalized(column: str, cell: str) -> str:
    if column in _LISTS:
        return " ".join(cell.split())
    return cell.lower().replace("-", ":") if column == "mac" else cell


def _parsed(values: Mapping[str, str]) -> dict[str, Value]:
    """The values as the inventory has them."""
    return {column: value.split() if column in _LISTS else value for column, value in values.items()}


def _errors_of(values: Mapping[str, str], place: Position) -> Iterator[Diagnostic]:
    """Errors of a row's values by the inventory's format."""
    for column, value in values.items():
        try:
            if column == NODE:
                TypeAdapter(Name).validate_python(Plain(value))
            else:
                parts: object = [Plain(part) for part in value.split()] if column in _LISTS else Plain(value)
                NodeDocument.model_validate({column: parts})
        except ValidationError as reason:
            (error, *_) = reason.errors(include_url=False, include_input=False)
            yield _wrong(place, column, expected_value(error), f"'{printable(value)}'")


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
