"""Rows of cells -> lines that fit a width: cells are shortened, then columns are dropped and listed.

Columns are dropped by rank, with the cells' short forms in between; empty columns are left out.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from meshctl.report.terminal_escapes import one_line
from meshctl.status.rows import COLUMNS, Column, TableCell

_GAP = "  "
# Columns of this rank or more are dropped before cells are shortened.
_SHORTEN_BELOW_RANK = 8
Paint = Callable[[str, str], str]
"""(text, style) -> text; styles: ok, degraded, unreachable, off, heading, known, error, warning, note, hint."""


def plain(text: str, style: str) -> str:
    """No style."""
    return text


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns to show, and whether cells are short; `dropped` are the headings of the others."""

    columns: tuple[Column, ...]
    is_short: bool
    dropped: tuple[str, ...]


def layout(rows: Sequence[Mapping[str, TableCell]], width: int | None) -> Layout:
    """The layout that fits into `width` characters (None: unlimited)."""
    columns = [column for column in COLUMNS if any(row.get(column.key, TableCell()).text for row in rows)]
    leaving = sorted((column for column in columns if column.rank), key=lambda column: -column.rank)
    dropped: set[str] = set()
    is_short = False
    while width is not None and _width(rows, _remaining(columns, dropped), is_short) > width:
        if not is_short and (not leaving or leaving[0].rank < _SHORTEN_BELOW_RANK):
            is_short = True
        elif leaving:
            dropped.add(leaving.pop(0).key)
        else:
            break
    # short cells may have made room for columns dropped earlier
    for column in sorted((column for column in columns if column.key in dropped), key=lambda column: column.rank):
        if _width(rows, _remaining(columns, dropped - {column.key}), is_short) <= (width or 0):
            dropped.discard(column.key)
    return Layout(
        _remaining(columns, dropped), is_short, tuple(column.heading for column in columns if column.key in dropped)
    )


def _remaining(columns: Sequence[Column], dropped: set[str]) -> tuple[Column, ...]:
    return tuple(column for column in columns if column.key not in dropped)


def _cell(row: Mapping[str, TableCell], column: Column, is_short: bool) -> str:
    cell = row.get(column.key, TableCell())
    return one_line(cell.shortest if is_short else cell.text) or "-"


def _widths(rows: Sequence[Mapping[str, TableCell]], columns: Sequence[Column], is_short: bool) -> list[int]:
    return [max([len(column.heading), *(len(_cell(row, column, is_short)) for row in rows)]) for column in columns]


def _width(rows: Sequence[Mapping[str, TableCell]], columns: Sequence[Column], is_short: bool) -> int:
    return sum(_widths(rows, columns, is_short)) + len(_GAP) * (len(columns) - 1)


def table_lines(rows: Sequence[Mapping[str, TableCell]], width: int | None = None, paint: Paint = plain) -> list[str]:
    """The heading, one line per row, and a note on dropped columns."""
    if not rows:
        return []
    shown = layout(rows, width)
    widths = _widths(rows, shown.columns, shown.is_short)
    pairs = list(zip(shown.columns, widths, strict=True))
    heading = _GAP.join(column.heading.ljust(room) for column, room in pairs).rstrip()
    lines = [paint(heading, "heading")]
    for row in rows:
        health = row["health"].text
        cells = []
        for column, room in pairs:
            text = _cell(row, column, shown.is_short)
            style = health if column.key == "health" else "known" if text.startswith("(") else ""
            cells.append(paint(text, style) + " " * (room - len(text)))
        lines.append(_GAP.join(cells).rstrip())
    if shown.dropped:
        note = f"columns not shown: {', '.join(shown.dropped)} (use --wide or --json)"
        lines += [paint(line, "note") for line in textwrap.wrap(note, width or len(note))]
    return lines
