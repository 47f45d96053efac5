"""A journal for commands that change nothing: where it cannot be written, they warn and continue.

A full disk or a read-only state directory must not hide the state of the fleet. Commands that change nodes open the
journal itself and are refused there, because an interrupted change could not be resumed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshctl.fleet.journal_schema import SCHEMA
from meshctl.fleet.sqlite_file import SqliteFile
from meshctl.fleet.store import Claim, Statement, Store, Transaction

_IN_MEMORY = Path(":memory:")


def _is_absent(path: Path) -> bool:
    """Whether there is certainly no file, unlike in a directory that may not be searched."""
    try:
        path.stat()
    except FileNotFoundError:
        return True
    except OSError:
        return False
    return False


class TolerantStore:
    """A `Store` whose `put` never raises: the first entry that cannot be written is reported to `notify`."""

    def __init__(self, store: Store, notify: Callable[[str], None], path: Path | None = None) -> None:
        self._store = store
        self._notify = notify
        self._is_reported = False
        self._path = store.path if path is None else path

    @classmethod
    def open(cls, path: Path, notify: Callable[[str], None], *, for_display: bool = False) -> TolerantStore:
        """The file at `path`, for reading alone if it cannot be written; empty if there is none and it cannot be
        created. Raises MeshctlError for a file that is no journal, and with `for_display` also if it is unknown
        whether there is a file."""
        try:
            return cls(SqliteFile(path, SCHEMA), notify)
        except MeshctlError as error:
            found: SqliteFile | None = None
            if os.path.exists(path):
                with suppress(MeshctlError):
                    found = SqliteFile(path, SCHEMA, read_only=True)
                if found is None:
                    raise
            elif for_display and not _is_absent(path):
                raise
            opened = cls(found or SqliteFile(_IN_MEMORY, SCHEMA), notify, path)
            opened.report(error)
            return opened

    def report(self, error: MeshctlError) -> None:
        """Warn once per command."""
        if not self._is_reported:
            self._is_reported = True
            hint = f"\n  hint: {error.hint}" if error.hint else ""
            self._notify(f"warning: {error}; continuing without recording{hint}")

    @property
    def path(self) -> Path:
        return self._path

    @property
    def is_shared(self) -> bool:
        return self._store.is_shared

    @property
    def notice(self) -> str:
        return self._store.notice

    def read(self, query: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        return self._store.read(query, values)

    def write(self, wait_s: float) -> AbstractContextManager[Transaction]:
        return self._store.write(wait_s)

    def put(self, statements: Sequence[Statement], wait_s: float) -> None:
        try:
            self._store.put(statements, wait_s)
        except MeshctlError as error:
            self.report(error)

    def claim(self, fleet: str, nodes: Sequence[str], run: int) -> tuple[Claim, ...]:
        return self._store.claim(fleet, nodes, run)

    def connected_runs(self) -> frozenset[int] | None:
        return self._store.connected_runs()

    def wait_for_change(self, timeout_s: float) -> bool:
        return self._store.wait_for_change(timeout_s)

    def close(self) -> None:
        self._store.close()
