"""Detect whether a file changed since it was parsed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class FileState:
    """Identity, size and time of the last change of a file: differs once the file is replaced or written."""

    device: int
    inode: int
    size_bytes: int
    changed_ns: int


def file_state(path: Path) -> FileState:
    """The state of a file now. Raises OSError."""
    found = path.stat()
    return FileState(found.st_dev, found.st_ino, found.st_size, found.st_ctime_ns)
