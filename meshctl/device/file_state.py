"""Detect whether a file changed since it was parsed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class FileState:
    """What changes when a file is replaced or written: identity, size, time of the last change."""

    device: int
    inode: int
    size_bytes: int
    changed_ns: int


def file_state(path: Path) -> FileState:
    """The state of a file now. Raises OSError."""
    found = path.stat()
    return FileState(found.st_dev, found.st_ino, found.st_size, found.st_ctime_ns)
