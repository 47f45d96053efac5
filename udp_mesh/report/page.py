"""The page of recordings. It is that of `meshctl monitor`, found by an entry point of the group `udp_mesh.report`: a
robot has udp_mesh alone, and reports as text."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, cast

GROUP = "udp_mesh.report"
WritePage = Callable[[Sequence[Path], Iterable[Mapping[str, Any]], Path, str], None]
"""Writes a page: (recordings, their documents, file, title); takes one document at a time. Raises OSError, or
ValueError for recordings that it cannot show."""


def page_writer() -> WritePage | None:
    """The function that writes the page; None if meshctl is not installed."""
    from importlib.metadata import entry_points

    for entry in entry_points(group=GROUP, name="page"):
        return cast("WritePage", entry.load())
    return None
