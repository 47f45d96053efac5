"""The document of a recording as text for a terminal: its notes and tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from udp_mesh.report.terminal_escapes import clean

_MAX_CELL = 32


def text_of(document: Mapping[str, Any]) -> str:
    """Every text in it is made safe for a terminal."""
    parts = [f"{_cell(document['node']) or 'recording'}: {' '.join(document['notes'])}"]
    parts += [_table(table) for table in document["tables"]]
    return "\n\n".join(parts)


def _table(table: Mapping[str, Any]) -> str:
    columns = table["columns"]
    rows = [[column["label"] for column in columns], *([_cell(cell) for cell in row] for row in table["rows"])]
    widths = [max(len(row[place]) for row in rows) for place in range(len(columns))]
    lines = [table["title"]]
    for row in rows:
        cells = [
            cell.rjust(width) if column["is_number"] else cell.ljust(width)
            for cell, width, column in zip(row, widths, columns, strict=True)
        ]
        lines.append(f"  {'  '.join(cells).rstrip()}")
    return "\n".join([*lines, *([f"  {table['note']}"] if table["note"] else [])])


def _cell(text: str) -> str:
    shown = clean(text, keep="")
    return shown if len(shown) <= _MAX_CELL else f"{shown[: _MAX_CELL - 1]}…"
