"""A file that a command reads, or standard input."""

from __future__ import annotations

import sys
from pathlib import Path

from meshctl.diagnostics import InvalidInput
from meshctl.inventory.source import MAX_FILE_BYTES, Source, read_source


def read_input(file: str) -> Source:
    """The text of the file; `-` is standard input. Raises InvalidInput."""
    if file == "-":
        found = read_source(Path("standard input"), lambda _: sys.stdin.buffer.read(MAX_FILE_BYTES + 1))
    else:
        found = read_source(Path(file))
    if isinstance(found, Source):
        return found
    raise InvalidInput([found])
