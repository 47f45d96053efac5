"""The journal of several operators: in PostgreSQL, and on this computer while the database is out of reach.

`merge` brings what was kept here into the database, in order: entries of runs that lost it,
then whole runs that began without it -> reads and writes go to the database. When the connection is lost, `put` keeps
statements in the spool, a SQLite file in the state directory, so a run in progress continues; `read` answers with what
this process read last. A database that is out of reach from the start leaves the file journal of this computer,
whose runs the spool lists for the next merge.

Everything that is merged has a unique origin or is idempotent: a merge that dies between the commit there and the
removal here repeats without effect.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshctl.fleet.journal_schema import LAB_SEPARATOR, REMEMBER, SCHEMA
from meshctl.fleet.postgresql import Database, DatabaseLost
from meshctl.fleet.process import is_process_alive, owner, this_process
from meshctl.fleet.run_files import runs_directory
from meshctl.fleet.sqlite_file import BUSY_TIMEOUT_S, Schema, SqliteFile
from meshctl.fleet.store import Claim, Statement, Transaction

_SPOOL = Schema(
    name="journal's spool",
    version=1,
    space_hint="set XDG_STATE_HOME to a directory on a writable disk with free space",
    statements="""
CREATE TABLE entries (id INTEGER PRIMARY KEY, target TEXT NOT NULL, statement TEXT NOT NULL, data TEXT NOT NULL) STRICT;
CREATE TABLE unmerged (
    target TEXT NOT NULL, run INTEGER NOT NULL, origin TEXT NOT NULL, PRIMARY KEY (target, run)
) STRICT;
""",
)
_RUN = "command, fleet, inventory, owner, process, plan, began_s, ended_s, result"
_OUTCOME = "node, result, reason, began_s, duration_s, facts"
_STEP = "node, step, began_s, duration_s, result"
# how often a process tries to reach a lost database again, beside its work
RETRY_S = 5.0
# stands for facts without a run
FACTS = 0
# statements sent in one transaction: a merge of a long run stays below the database's time limit
_MERGE_BATCH = 500


class Spool:
    """Entries kept on this computer for unreachable databases; `target` is the label of one."""

    def __init__(self, journal: Path) -> None:
        self._path = journal.with_name("shared.sqlite")
        self._file: SqliteFile | None = None

    @property
    def _opened(self) -> SqliteFile:
        if self._file is None:
            self._file = SqliteFile(self._path, _SPOOL)
        return self._file

    def keep(self, target: str, statements: Sequence[Statement]) -> None:
        with self._opened.write() as database:
            database.executemany(
                "INSERT INTO entries (target, statement, data) VALUES (?, ?, ?)",
                [(target, statement, json.dumps(values)) for statement, values in statements],
            )

    def entries(self, target: str) -> list[tuple[int, Statement]]:
        if not self._path.exists():
            return []
        rows = self._opened.read(
            "SELECT id, statement, data FROM entries WHERE target = ? ORDER BY id LIMIT ?", (target, _MERGE_BATCH)
        )
        return [(number, (statement, tuple(json.loads(data)))) for number, statement, data in rows]

    def remove(self, last: int, target: str) -> None:
        with self._opened.write() as database:
            database.execute("DELETE FROM entries WHERE target = ? AND id <= ?", (target, last))

    def note_unmerged(self, target: str, run: int) -> None:
        """Note that a run of this computer's journal has to be merged; its origin is unique among all computers."""
        origin = f"{owner()} {this_process()} {run}"
        with self._opened.write() as database:
            database.execute("INSERT OR REPLACE INTO unmerged VALUES (?, ?, ?)", (target, run, origin))

    def unmerged(self, target: str) -> list[tuple[int, str]]:
        if not self._path.exists():
            return []
        return self._opened.read("SELECT run, origin FROM unmerged WHERE target = ? ORDER BY run", (target,))

    def forget(self, target: str, run: int) -> None:
        with self._opened.write() as database:
            database.execute("DELETE FROM unmerged WHERE target = ? AND run = ?", (target, run))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


class SharedStore:
    """A journal in PostgreSQL. `path` names where this computer keeps the files of its runs; no file is there."""

    def __init__(self, database: Database, local: Path) -> None:
        digest = hashlib.sha256(database.label.encode()).hexdigest()[:12]
        self.path = local.parent / f"shared-{digest}" / "journal"
        self._database = database
        self._spool = Spool(local)
        self._guard = threading.Lock()
        self._closing = threading.Event()
        self._lost = ""
        self._kept = 0
        self._answers: dict[tuple[str, tuple[object, ...]], list[tuple[Any, ...]]] = {}

    @property
    def is_shared(self) -> bool:
        return True

    @property
    def notice(self) -> str:
        if not self._lost:
            return ""
        return (
            f"{self._lost}; {self._kept} journal entries are kept on this computer, and the next command that reaches"
            " the database sends them"
        )

    def read(self, query: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        with self._guard:
            if not self._lost:
                try:
                    rows = self._database.read(query, values)
                except DatabaseLost as error:
                    self._lose(error)
                else:
                    self._answers[query, values] = rows
                    return rows
            if (query, values) not in self._answers:
                raise DatabaseLost(self._lost, hint="run the command again: it then uses the journal of this computer")
            return self._answers[query, values]

    @contextmanager
    def write(self, wait_s: float = BUSY_TIMEOUT_S) -> Iterator[Transaction]:
        with self._database.transaction() as transaction:
            yield transaction

    def put(self, statements: Sequence[Statement], wait_s: float = BUSY_TIMEOUT_S) -> None:
        with self._guard:
            if not self._lost:
                try:
                    with self._database.transaction() as transaction:
                        for statement in statements:
                            transaction.execute(*statement)
                except DatabaseLost as error:
                    self._lose(error)
                else:
                    return
            self._spool.keep(self._database.label, statements)
            self._kept += len(statements)

    def _lose(self, error: DatabaseLost) -> None:
        """From now on all entries go to the spool, so that they stay in order; a thread tries to connect again."""
        self._lost = str(error)
        threading.Thread(target=self._recover, name="shared journal", daemon=True).start()

    def _recover(self) -> None:
        while not self._closing.wait(RETRY_S):
            with suppress(MeshctlError):
                self._database.reconnect()
                with self._guard:
                    self._send_entries()
                    self._lost, self._kept = "", 0
                return

    def _send_entries(self) -> None:
        label = self._database.label
        while entries := self._spool.entries(label):
            with self._database.transaction() as transaction:
                for _, statement in entries:
                    transaction.execute(*statement)
            self._spool.remove(entries[-1][0], label)

    def claim(self, fleet: str, nodes: Sequence[str], run: int) -> tuple[Claim, ...]:
        try:
            taken = self._database.lock_nodes(fleet, nodes)
            if not taken:
                self._database.lock_run(run)
            return tuple(self._owner(fleet, node) for node in taken)
        except DatabaseLost:
            # the locks on the nodes remain
            return ()

    def _owner(self, fleet: str, node: str) -> Claim:
        rows = self._database.read(
            "SELECT owner, id FROM runs JOIN outcomes ON run = id WHERE fleet = ? AND node = ? AND ended_s IS NULL"
            " ORDER BY id DESC",
            (fleet, node),
        )
        connected = self._database.connected_runs()
        by, run = next((row for row in rows if row[1] in connected), ("another operator", 0))
        return Claim(node, by, run)

    def connected_runs(self) -> frozenset[int] | None:
        try:
            return self._database.connected_runs()
        except DatabaseLost:
            return None

    def wait_for_change(self, timeout_s: float) -> bool:
        return self._database.wait_for_change(timeout_s)

    def close(self) -> None:
        self._closing.set()
        with self._guard:
            self._spool.close()
            self._database.close()

    def merge(self, local: Path) -> tuple[int, ...]:
        """Bring everything that was kept on this computer into the database; the new numbers of merged runs. Raises
        MeshctlError; what was not merged stays here."""
        label = self._database.label
        self._send_entries()
        merged: list[int] = []
        waiting = self._spool.unmerged(label)
        if not waiting:
            return ()
        journal = SqliteFile(local, SCHEMA, read_only=True)
        try:
            for run, origin in waiting:
                if run == FACTS:
                    self._merge_facts(journal)
                    self._spool.forget(label, run)
                elif (number := self._merge_run(journal, run, origin)) is not None:
                    self._copy_files(local, run, number)
                    self._spool.forget(label, run)
                    merged.append(number)
        finally:
            journal.close()
        return tuple(merged)

    def _merge_run(self, journal: SqliteFile, run: int, origin: str) -> int | None:
        """The number of the run in the database; None while its process lives."""
        rows = journal.read(f"SELECT {_RUN} FROM runs WHERE id = ?", (run,))
        if not rows:
            return None
        record = rows[0]
        if record[7] is None and is_process_alive(record[4]):
            return None
        with self._database.transaction() as transaction:
            columns = ", ".join("?" * (len(record) + 1))
            transaction.execute(
                f"INSERT INTO runs ({_RUN}, origin) VALUES ({columns}) ON CONFLICT (origin) DO NOTHING",
                (*record, origin),
            )
            ((number,),) = transaction.execute("SELECT id FROM runs WHERE origin = ?", (origin,)).fetchall()
            for table, names in (("outcomes", _OUTCOME), ("steps", _STEP)):
                marks = ", ".join("?" * (names.count(",") + 2))
                found = journal.read(f"SELECT {names} FROM {table} WHERE run = ? ORDER BY rowid", (run,))
                transaction.executemany(
                    f"INSERT INTO {table} (run, {names}) VALUES ({marks}) ON CONFLICT DO NOTHING",
                    [(number, *row) for row in found],
                )
        return int(number)

    def _merge_facts(self, journal: SqliteFile) -> None:
        """Every node's facts, unless the database has newer ones; those of labs stay here."""
        with self._database.transaction() as transaction:
            rows = journal.read(
                "SELECT fleet, node, seen_s, facts FROM nodes WHERE instr(fleet, ?) = 0", (LAB_SEPARATOR,)
            )
            transaction.executemany(REMEMBER, rows)

    def _copy_files(self, local: Path, run: int, number: int) -> None:
        # without them the run cannot be rolled back, which `meshctl rollback` says
        with suppress(OSError):
            shutil.copytree(
                runs_directory(local) / str(run), runs_directory(self.path) / str(number), dirs_exist_ok=True
            )
