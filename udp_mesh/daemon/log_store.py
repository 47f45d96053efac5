"""Items of shared logs on disk: one SQLite database, written by one thread in batches.

`put`, `get`, `take` and `drop` queue a job; the thread does all that wait in one transaction (WAL, `synchronous=FULL`:
what is reported as stored survives a power cut), then reports the results on the event loop. However slow the disk, the
loop never waits for it. A damaged database is renamed and a new one begun, with a new identity: the secret of this
node's logs is in the database, so that no number is ever used twice. Rows that make no sense are left out (`log_rows`).

A full disk takes no new database, but an old one is opened and read. Without a database on disk, or while another
process has locked it, one in memory is used, and copied to the disk as soon as that takes it (`_move_to_disk`).
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import queue
import sqlite3
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from udp_mesh.core.logs.item import ItemId
from udp_mesh.core.logs.store import ItemUse, LogContents, RememberedLog
from udp_mesh.daemon.log_join import join_logs, log_number, remember, with_earlier
from udp_mesh.daemon.log_rows import SCHEMA, load_rows

log = logging.getLogger(__name__)

LOCK_WAIT_S = 1.0
"""How long to wait for another process to release the database, at the start."""
MAX_BATCH = 256
"""Jobs in one transaction: a long one delays the answers."""
LOG_AGAIN_S = 60.0
"""Minimum interval between two log lines about a failing disk."""
MOVE_AGAIN_S = 10.0
"""Interval between two attempts to move the database from memory to the disk."""
_VERSION = 1

Job = Callable[[sqlite3.Connection], Callable[[], None] | None]
"""Runs in the thread, within a transaction; returns what to call on the loop once it is committed."""
_QueuedJob = tuple[Job, Callable[[], None]]
"""A job, and what to call on the loop if it fails."""


@dataclass(slots=True, eq=False)
class Put:
    """One item being stored, for a publisher that waits for it."""

    stored: asyncio.Event = field(default_factory=asyncio.Event)
    """Set once the disk has answered."""
    problem: str | None = None
    """Then: why the item is not on disk, or None."""


class SqliteLogStore:
    """The core's `LogStore` over a file (created by `load`, readable only by its owner). `on_done` is called on the
    loop after results were reported; `wall_clock` is Unix time in seconds."""

    def __init__(self, path: Path, wall_clock: Callable[[], float]) -> None:
        self.path = path
        self.on_done: Callable[[], None] = lambda: None
        self.refused = 0
        """Items not stored because the disk is full or failed."""
        self.problem: str | None = None
        """Why the last item was not stored; None after one was."""
        self.last_put: Put | None = None
        """The latest call of `put`."""
        self._memory_only: str | None = None
        """Why items are kept in memory only."""
        self._joined = False
        """The database has what it held before this run could use it, and of which the core does not know."""
        self._move_at = 0.0
        self._wall_clock = wall_clock
        self._jobs: queue.SimpleQueue[_QueuedJob | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._logged_at = float("-inf")

    @property
    def files(self) -> tuple[Path, ...]:
        """The database's files that exist."""
        names = (self.path.parent, self.path, *(Path(f"{self.path}{suffix}") for suffix in ("-wal", "-shm")))
        return tuple(path for path in names if path.exists())

    def unix_ms(self) -> int:
        return int(self._wall_clock() * 1000)

    def load(self) -> LogContents:
        """Opens the database, or a new one. If the disk takes neither, items are kept in memory for now, and a line is
        logged."""
        try:
            connection, contents = self._open(str(self.path))
        except sqlite3.DatabaseError as error:
            if _is_damaged(error):
                damaged = self.path.with_suffix(f".damaged-{int(self._wall_clock())}")
                log.error("log-damaged path=%s renamed=%s error=%s", self.path, damaged, error)
                with contextlib.suppress(OSError):
                    self.path.rename(damaged)
                for suffix in ("-wal", "-shm"):
                    Path(f"{self.path}{suffix}").unlink(missing_ok=True)
                connection, contents = self._open_or_memory()
            else:
                connection, contents = self._in_memory(error)
        except OSError as error:
            connection, contents = self._in_memory(error)
        self._loop = asyncio.get_running_loop()
        self._thread = threading.Thread(target=self._run, args=(connection,), name="log-store", daemon=True)
        self._thread.start()
        return contents

    def _open_or_memory(self) -> tuple[sqlite3.Connection, LogContents]:
        try:
            return self._open(str(self.path))
        except (sqlite3.Error, OSError) as error:
            return self._in_memory(error)

    def _in_memory(self, error: Exception) -> tuple[sqlite3.Connection, LogContents]:
        log.error("log-unusable path=%s error=%s: items are kept in memory only", self.path, error)
        self._memory_only = str(error)
        self._move_at = time.monotonic() + MOVE_AGAIN_S
        return self._open(":memory:")

    def _open(self, name: str) -> tuple[sqlite3.Connection, LogContents]:
        connection = self._connect(name)
        try:
            version = connection.execute("PRAGMA user_version").fetchone()[0]
            if version > _VERSION:
                raise OSError(f"expected a log of version {_VERSION} or earlier, found {version}")
            connection.executescript(SCHEMA)
            if version < _VERSION:
                # Needless writes would fail on a full disk, where an old database can still be read.
                connection.execute(f"PRAGMA user_version = {_VERSION}")
            return connection, self._contents(connection)
        except BaseException:
            connection.close()
            raise

    def _connect(self, name: str) -> sqlite3.Connection:
        if name != ":memory:":
            self.path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            os.close(os.open(self.path, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600))
        connection = sqlite3.connect(name, isolation_level=None, check_same_thread=False, timeout=LOCK_WAIT_S)
        try:
            # A second daemon on the same directory would number its items alike: it does not get the database.
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            connection.execute("PRAGMA journal_mode = WAL")
            connection.execute("PRAGMA synchronous = FULL")
        except BaseException:
            connection.close()
            raise
        return connection

    def _contents(self, connection: sqlite3.Connection) -> LogContents:
        rows = load_rows(connection, self._wall_clock())
        for problem in rows.problems:
            log.error("log-row-unusable path=%s %s", self.path, problem)
        if rows.problem_count > len(rows.problems):
            log.error("log-row-unusable path=%s more=%d", self.path, rows.problem_count - len(rows.problems))
        if rows.new_identity:
            log.error("log-identity-renewed path=%s: numbers that were used before are in doubt", self.path)
        if rows.orphans:
            # Nothing says which topic they belong to.
            log.error("log-items-without-log path=%s items=%d: deleted", self.path, rows.orphans)
            connection.execute("DELETE FROM items WHERE log NOT IN (SELECT id FROM logs)")
        return rows.contents

    # Jobs

    def put(self, item: ItemId, data: bytes, use: ItemUse, done: Callable[[bool], None]) -> None:
        stored_s = self._wall_clock()
        put = self.last_put = Put()

        def insert(connection: sqlite3.Connection) -> Callable[[], None]:
            connection.execute(
                "INSERT OR REPLACE INTO items (log, number, data, stored_s, taken) VALUES (?, ?, ?, ?, ?)",
                (log_number(connection, item.log), item.number, data, stored_s, int(use)),
            )
            return stored

        def stored() -> None:
            self.problem = put.problem = self._memory_only
            put.stored.set()
            done(True)

        def failed() -> None:
            self.refused += 1
            put.problem = self.problem
            put.stored.set()
            done(False)

        self._jobs.put((insert, failed))

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        def select(connection: sqlite3.Connection) -> Callable[[], None]:
            row = connection.execute(
                "SELECT data FROM items JOIN logs ON items.log = logs.id"
                " WHERE topic = ? AND source = ? AND log_id = ? AND number = ?",
                (*item.log, item.number),
            ).fetchone()
            return lambda: done(None if row is None else bytes(row[0]))

        self._jobs.put((select, lambda: done(None)))

    def mark(self, items: Iterable[ItemId], use: ItemUse) -> None:
        marked = tuple(items)

        def update(connection: sqlite3.Connection) -> None:
            for item in marked:
                where = (int(use), log_number(connection, item.log), item.number)
                connection.execute("UPDATE items SET taken = ? WHERE log = ? AND number = ?", where)

        self._jobs.put((update, lambda: None))

    def drop(self, items: Iterable[ItemId], remembered: Iterable[RememberedLog]) -> None:
        gone, kept = tuple(items), tuple(remembered)

        def delete(connection: sqlite3.Connection) -> None:
            for item in gone:
                where = (log_number(connection, item.log), item.number)
                connection.execute("DELETE FROM items WHERE log = ? AND number = ?", where)
            for entry in kept:
                row = log_number(connection, entry.log)
                remember(connection, row, with_earlier(connection, row, entry) if self._joined else entry)

        self._jobs.put((delete, lambda: None))

    def close(self) -> None:
        """Waits until everything queued is done."""
        if self._thread is not None:
            self._jobs.put(None)
            self._thread.join()
            self._thread = None

    # The thread

    def _run(self, connection: sqlite3.Connection) -> None:
        last = False
        while not last:
            batch, last = self._next_batch()
            if batch:
                self._report(self._commit(connection, batch))
            if self._memory_only is not None and (last or time.monotonic() >= self._move_at):
                connection = self._move_to_disk(connection)
        connection.close()

    def _next_batch(self) -> tuple[list[_QueuedJob], bool]:
        """Waits for jobs, while items are in memory only for a limited time; and whether they are the last ones."""
        batch: list[_QueuedJob] = []
        with contextlib.suppress(queue.Empty):
            following = self._jobs.get(timeout=None if self._memory_only is None else MOVE_AGAIN_S)
            while following is not None:
                batch.append(following)
                if len(batch) == MAX_BATCH:
                    return batch, False
                following = self._jobs.get_nowait()
            return batch, True
        return batch, False

    def _move_to_disk(self, connection: sqlite3.Connection) -> sqlite3.Connection:
        """Copies the database in memory to the disk, if that takes it now; returns the one to use. A database that is
        there and no longer locked keeps its items and its identity, and gets the items in memory as well."""
        self._move_at = time.monotonic() + MOVE_AGAIN_S
        try:
            on_disk = self._connect(str(self.path))
        except (sqlite3.Error, OSError):
            return connection
        try:
            earlier = self._copy(connection, on_disk)
            (items,) = on_disk.execute("SELECT count(*) FROM items").fetchone()
        except (sqlite3.Error, OSError):
            on_disk.close()
            return connection
        connection.close()
        log.warning("log-moved-to-disk path=%s items=%d earlier=%d", self.path, items, earlier)
        self._memory_only = self.problem = None
        return on_disk

    def _copy(self, connection: sqlite3.Connection, on_disk: sqlite3.Connection) -> int:
        """The number of items that were there. Raises OSError if the database is of a later version."""
        if on_disk.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,):
            connection.backup(on_disk)
            return 0
        (version,) = on_disk.execute("PRAGMA user_version").fetchone()
        if version != _VERSION:
            raise OSError(f"expected a log of version {_VERSION}, found {version}")
        earlier = join_logs(connection, on_disk)
        self._joined = True
        return earlier

    def _commit(self, connection: sqlite3.Connection, batch: list[_QueuedJob]) -> list[Callable[[], None]]:
        """Does a batch in one transaction; returns what to call on the loop."""
        try:
            # Deferred: reading must go on while writing is impossible, as on a file system that became read-only.
            connection.execute("BEGIN")
            results = [job(connection) for job, _ in batch]
            connection.execute("COMMIT")
        except Exception as error:  # noqa: BLE001 - reported to each caller
            # Whatever fails (memory, too), the thread continues and every caller gets an answer.
            with contextlib.suppress(sqlite3.Error):
                connection.execute("ROLLBACK")
            if len(batch) > 1:
                # One large item may not fit where small ones do, and reading needs no space.
                return [call for job in batch for call in self._commit(connection, [job])]
            now = time.monotonic()
            if now - self._logged_at >= LOG_AGAIN_S:
                self._logged_at = now
                log.error("log-write-failed path=%s error=%s", self.path, error)
            return [partial(self._failed, str(error), batch[0][1])]
        return [result for result in results if result is not None]

    def _failed(self, problem: str, call: Callable[[], None]) -> None:
        self.problem = problem
        call()

    def _report(self, calls: list[Callable[[], None]]) -> None:
        def report() -> None:
            for call in calls:
                try:
                    call()
                except Exception:
                    # The others of the batch wait for their answers all the same.
                    log.exception("log-callback-failed path=%s", self.path)
            self.on_done()

        assert self._loop is not None
        with contextlib.suppress(RuntimeError):
            # The loop is closed: no caller waits for the results.
            self._loop.call_soon_threadsafe(report)


def _is_damaged(error: sqlite3.DatabaseError) -> bool:
    """Whether the file is no sound database, rather than out of reach for now."""
    return error.sqlite_errorcode & 0xFF in (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
