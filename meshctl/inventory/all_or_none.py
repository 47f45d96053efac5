"""New files that are written together or not at all: `with all_or_none(...) as new_files: new_files.create(...)`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from meshctl.errors import InputError


class NewFiles:
    """`created` so far; the last one may be incomplete."""

    def __init__(self) -> None:
        self.created: list[Path] = []

    def create(self, path: Path, content: bytes, *, mode: int = 0o666) -> None:
        """Write a new file, and its directory if there is none. Raises OSError, also if the file exists."""
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as stream:
            self.created.append(path)
            stream.write(content)


@contextmanager
def all_or_none(place: Path) -> Iterator[NewFiles]:
    """Remove the new files if the block fails or is interrupted: a part of one would be in the way of the next try.

    Raises InputError for an OSError that names no file as one of `place`.
    """
    new_files = NewFiles()
    try:
        yield new_files
    except BaseException as reason:
        for path in new_files.created:
            path.unlink(missing_ok=True)
        if isinstance(reason, OSError):
            raise InputError(f"{reason.filename or place} cannot be written: {reason.strerror}") from reason
        raise
