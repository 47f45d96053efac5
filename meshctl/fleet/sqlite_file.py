"""A SQLite file of meshctl: how it is opened, locked, read and written, and what its errors mean.

WAL, so that two meshctl processes can write and a killed one leaves it readable. The journal and the monitor's history
are such files.
"""

from __future__ import annotations

import os
import re
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshctl.fleet.store import Claim, Statement

# Two processes may write concurrently; a transaction takes milliseconds, so this is more than enough.
BUSY_TIMEOUT_S = 20.0
_LOOK_S = 0.25
_TABLE = re.compile(r"CREATE TABLE (\w+)")


@dataclass(frozen=True, slots=True)
class Schema:
    """The tables of a file. `name` is what messages call it (`journal`); `space_hint` says what to do if it cannot be
    written; `pragmas` are set on every connection."""

    name: str
    version: int
    statements: str
    space_hint: str
    pragmas: tuple[str, ...] = ()

    @property
    def tables(self) -> frozenset[str]:
        return frozenset(_TABLE.findall(self.statements))


class SqliteFile:
    """The open file. Safe for several threads and processes; `read_only` neither creates nor changes it."""

    def __init__(self, path: Path, schema: Schema, *, read_only: bool = False) -> None:
        """Open the file, or create it. Raises MeshctlError."""
        self.path = path
        self._schema = schema
        self._lock = threading.Lock()
        self._data_version: int | None = None
        if read_only:
            self._open_read_only()
        else:
            self._open()

    def _open(self) -> None:
        path, schema = self.path, self._schema
        try:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._database = sqlite3.connect(
                path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
            )
        except (OSError, sqlite3.Error) as error:
            reason = f"{path}: cannot open the {schema.name}: {self._reason(error)}"
            raise MeshctlError(reason, hint=self._hint(error)) from error
        try:
            # a foreign file stays as it is
            self._retried(self._check_owner)
            for pragma in schema.pragmas:
                self._database.execute(f"PRAGMA {pragma}")
            self._retried(lambda: self._database.execute("PRAGMA journal_mode = WAL"))
            self._database.execute("PRAGMA synchronous = NORMAL")
            self._database.execute("PRAGMA foreign_keys = ON")
            self._create()
        except (sqlite3.Error, MeshctlError) as error:
            self._database.close()
            if isinstance(error, MeshctlError):
                raise
            what = f"cannot open the {schema.name}" if self._hint(error) else f"not a {schema.name} of meshctl"
            hint = self._hint(error) or "move the file away and run again"
            raise MeshctlError(f"{path}: {what}: {self._reason(error)}", hint=hint) from error

    def _open_read_only(self) -> None:
        """Open it without changing anything. Where nothing can be written, no other process writes either."""
        error: Exception = MeshctlError("not opened")
        for mode in ("mode=ro", "immutable=1"):
            try:
                uri = f"{self.path.resolve().as_uri()}?{mode}"
                self._database = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            except sqlite3.Error as failed:
                error = failed
                continue
            try:
                version = self._version()
                self._check_owner()
            except MeshctlError:
                self._database.close()
                raise
            except sqlite3.Error as failed:
                error = failed
                self._database.close()
                continue
            if version == self._schema.version:
                return
            self._database.close()
            error = MeshctlError(f"found version {version}, expected {self._schema.version}")
            break
        raise MeshctlError(f"{self.path}: cannot read as a {self._schema.name}: {self._reason(error)}") from error

    def _check_owner(self) -> None:
        """Raises MeshctlError for a database with tables that are not ours."""
        # in this order: while another process creates the file, there are no tables, or all of them
        found = {row[0] for row in self._database.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
        version, schema = self._version(), self._schema
        if found and (version == 0 or (version == schema.version and not schema.tables <= found)):
            raise MeshctlError(
                f"{self.path}: not a {schema.name} of meshctl: found the tables {', '.join(sorted(found)[:5])}",
                hint="name another file; this one was left as it is",
            )

    def _retried(self, step: Callable[[], object]) -> None:
        # When two processes create the file concurrently, SQLite reports "locked" here without waiting.
        deadline = time.monotonic() + BUSY_TIMEOUT_S
        while True:
            try:
                step()
            except sqlite3.OperationalError as error:
                if not _is_locked(error) or time.monotonic() > deadline:
                    raise
                time.sleep(0.01)
            else:
                return

    def _create(self) -> None:
        # a reader does not wait for a writer
        expected = self._schema.version
        if self._version() == expected:
            return
        with self.write() as database:
            version = self._version()
            if version == 0:
                for statement in self._schema.statements.split(";\n"):
                    if statement.strip():
                        database.execute(statement)
                database.execute(f"PRAGMA user_version = {expected}")
            elif version != expected:
                raise MeshctlError(f"{self.path}: {self._schema.name} of version {version}, expected {expected}")

    def _version(self) -> int:
        return int(self._database.execute("PRAGMA user_version").fetchone()[0])

    @contextmanager
    def write(self, wait_s: float = BUSY_TIMEOUT_S) -> Iterator[sqlite3.Connection]:
        """One transaction, rolled back if the block raises. Raises MeshctlError if the file cannot be written, or is
        locked for longer than `wait_s`."""
        with self._lock:
            try:
                self._database.execute(f"PRAGMA busy_timeout = {round(wait_s * 1000)}")
                self._database.execute("BEGIN IMMEDIATE")
                try:
                    yield self._database
                except BaseException:
                    self._database.execute("ROLLBACK")
                    raise
                self._database.execute("COMMIT")
            except sqlite3.Error as error:
                # a COMMIT on a full disk may leave its transaction open
                if self._database.in_transaction:
                    with suppress(sqlite3.Error):
                        self._database.execute("ROLLBACK")
                what = f"cannot write the {self._schema.name}"
                raise MeshctlError(f"{self.path}: {what}: {self._reason(error)}", hint=self._hint(error)) from error

    def put(self, statements: Sequence[Statement], wait_s: float = BUSY_TIMEOUT_S) -> None:
        """Execute statements in one transaction. Raises MeshctlError, as `write` does."""
        with self.write(wait_s) as database:
            for statement in statements:
                database.execute(*statement)

    @property
    def is_shared(self) -> bool:
        return False

    @property
    def notice(self) -> str:
        return ""

    def claim(self, fleet: str, nodes: Sequence[str], run: int) -> tuple[Claim, ...]:
        """None is refused: on one computer the lock on the node is enough."""
        return ()

    def connected_runs(self) -> frozenset[int] | None:
        return None

    def wait_for_change(self, timeout_s: float) -> bool:
        """Wait until another process has written, or the time is over; whether one has."""
        deadline = time.monotonic() + timeout_s
        while True:
            ((data_version,),) = self.read("PRAGMA data_version", ())
            if data_version != self._data_version:
                self._data_version = data_version
                return True
            if (left := deadline - time.monotonic()) <= 0:
                return False
            time.sleep(min(_LOOK_S, left))

    def read(self, query: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        """The rows of a query. Raises MeshctlError."""
        with self._lock:
            try:
                return self._database.execute(query, values).fetchall()
            except sqlite3.Error as error:
                raise MeshctlError(f"{self.path}: cannot read the {self._schema.name}: {error}") from error

    def close(self) -> None:
        with self._lock:
            self._database.close()

    def _reason(self, error: Exception) -> str:
        """Why the file cannot be used; SQLite says neither which file nor what is wrong with it."""
        if isinstance(error, OSError) and error.strerror:
            return error.strerror
        code = _primary(error)
        if code == sqlite3.SQLITE_FULL:
            return "the disk is full"
        if code not in (sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_PERM):
            return str(error)
        if self.path.is_dir():
            return "it is a directory"
        if not self.path.parent.is_dir():
            return f"there is no directory {self.path.parent}"
        if self.path.exists() and not os.access(self.path, os.R_OK | os.W_OK):
            return "you may not read and write it"
        # SQLite's files beside it are written even to read it
        return str(error) if os.access(self.path.parent, os.W_OK) else f"{self.path.parent} cannot be written"

    def _hint(self, error: Exception) -> str:
        """A hint if the file cannot be used; empty if its content is at fault."""
        if _is_locked(error):
            return "another process has locked it: run `fuser` with its path to find that process"
        if isinstance(error, OSError) or _primary(error) in _UNWRITABLE:
            return self._schema.space_hint
        return ""


# SQLite's primary result codes (sqlite.org/rescode.html) are the low eight bits of the extended ones.
_PRIMARY = 0xFF
_LOCKED = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED)
_UNWRITABLE = (
    *(sqlite3.SQLITE_FULL, sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN),
    *(sqlite3.SQLITE_IOERR, sqlite3.SQLITE_PERM),
)


def _primary(error: Exception) -> int:
    return int(getattr(error, "sqlite_errorcode", 0)) & _PRIMARY


def _is_locked(error: Exception) -> bool:
    return _primary(error) in _LOCKED
