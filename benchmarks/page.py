"""Write a benchmark's output to `docs/benchmarks.md`, between the two comments of its section, with its machine."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


def this_machine() -> dict[str, str | int | None]:
    """What to record with each result: Python's version, the architecture and the number of cores."""
    return {"python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count()}


def fill(section: str, text: str, page: Path = PAGE) -> None:
    """Replace the text between `<!-- section: command -->` and `<!-- end of section -->`.

    Raises ValueError when the page has no such pair of comments.
    """
    name = re.escape(section)
    between = re.compile(rf"(<!-- {name}: [^\n]*-->\n).*?(\n<!-- end of {name} -->)", re.DOTALL)
    filled, count = between.subn(lambda marks: f"{marks[1]}\n{text.strip()}\n{marks[2]}", page.read_text())
    if count != 1:
        raise ValueError(f"{page}: expected one section {section!r} between its two comments, found {count}")
    page.write_text(filled)
