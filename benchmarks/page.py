"""A benchmark's results: one line of JSON each in its file, and its output in `docs/benchmarks.md`, between the two
comments of its section, with its machine."""

from __future__ import annotations

import json
import os
import platform
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "benchmarks.md"


def this_machine() -> dict[str, str | int | None]:
    """What to record with each result: Python's version, the architecture and the number of cores."""
    return {"python": platform.python_version(), "machine": platform.machine(), "cores": os.cpu_count()}


def append_result(path: Path, result: Mapping[str, Any]) -> None:
    """Add a result to the file, so that what was measured is kept if a later measurement fails."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(result) + "\n")


def read_results(path: Path) -> list[dict[str, Any]]:
    """The results in the file, in the order of measuring; none if there is no file."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


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
