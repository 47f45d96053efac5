"""What was done to the fleet, on disk: runs, steps, outcomes, and the last known state of every node.

One SQLite file in `$XDG_STATE_HOME/meshctl` (WAL, so that two meshctl processes write at once and a killed one leaves
it readable). `Journal.begin` opens a run; `Run.step`, `Run.finish_node` and `Run.end` fill it; `runs`, `steps`,
`outcomes`, `unfinished` and `last_known` read it. Nothing secret is ever written.

A fleet that is practised with in a lab has the same name and the same nodes as the real one. Their runs and facts are
kept apart: a journal opened for a lab reads and writes under the fleet's name and the lab's directory.
"""

from __future__ import annotations

import json
import sqlite3
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from meshctl.errors import MeshctlError
from meshctl.fleet.outcome import Outcome, Result
from meshctl.fleet.process import owner, process_lives, this_process

SCHEMA_VERSION = 1
# Two processes may write at once; each transaction takes milliseconds, so this is far more than ever needed.
BUSY_TIMEOUT_S = 20.0
# In the middle of a run nodes wait to be confirmed: a journal that somebody holds is written to later.
STEP_TIMEOUT_S = 1.0
# between the name of a fleet and the directory of its lab; ASCII's own character for this (unit separator)
_LAB_SEPARATOR = "\x1f"
_RUN_COLUMNS = "id, command, fleet, inventory, owner, process, plan, began_s, ended_s, result"
# Outcomes of a node that leave open what became of a change begun before.
_END_UNKNOWN = (Result.UNCERTAIN, Result.PENDING, Result.UNREACHABLE)
_SCHEMA = """
CREATE TABLE runs (
    id INTEGER PRIMARY KEY, command TEXT NOT NULL, fleet TEXT NOT NULL, inventory TEXT NOT NULL, owner TEXT NOT NULL,
    process TEXT NOT NULL, plan TEXT NOT NULL, began_s REAL NOT NULL, ended_s REAL, result TEXT NOT NULL DEFAULT ''
) STRICT;
CREATE TABLE outcomes (
    run INTEGER NOT NULL REFERENCES runs(id), node TEXT NOT NULL, result TEXT NOT NULL, reason TEXT NOT NULL DEFAULT '',
    began_s REAL NOT NULL, duration_s REAL NOT NULL DEFAULT 0, facts TEXT NOT NULL DEFAULT '{}', PRIMARY KEY (run, node)
) STRICT;
CREATE TABLE steps (
    id INTEGER PRIMARY KEY, run INTEGER NOT NULL REFERENCES runs(id), node TEXT NOT NULL, step TEXT NOT NULL,
    began_s REAL NOT NULL, duration_s REAL, result TEXT NOT NULL DEFAULT ''
) STRICT;
CREATE INDEX steps_of_run ON steps(run, node);
CREATE TABLE nodes (
    fleet TEXT NOT NULL, node TEXT NOT NULL, seen_s REAL NOT NULL, facts TEXT NOT NULL, PRIMARY KEY (fleet, node)
) STRICT;
"""
_REMEMBER = (
    "INSERT INTO nodes (fleet, node, seen_s, facts) VALUES (?1, ?2, ?3, ?4) ON CONFLICT (fleet, node)"
    " DO UPDATE SET seen_s = ?3, facts = ?4 WHERE ?3 >= seen_s"
)


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run; `result` is empty while it is under way, `interrupted` when its process died without a word."""

    id: int
    command: str
    fleet: str
    inventory: str
    owner: str
    process: str
    plan: str
    began_s: float
    ended_s: float | None
    result: str
    lab: str = ""
    """The lab's directory, for a run in a virtual fleet."""

    @property
    def is_over(self) -> bool:
        return self.ended_s is not None or not process_lives(self.process)

    @property
    def state(self) -> str:
        if self.ended_s is not None:
            return self.result
        return "under way" if process_lives(self.process) else "interrupted"


@dataclass(frozen=True, slots=True)
class StepRecord:
    node: str
    step: str
    began_s: float
    duration_s: float | None
    result: str


@dataclass(frozen=True, slots=True)
class LastKnown:
    """What a node told when it was last seen, at `seen_s` (Unix time)."""

    node: str
    seen_s: float
    facts: Mapping[str, str]


class Journal:
    """The file. Safe to use from several threads and processes; close it, or use it in a `with` block."""

    def __init__(self, path: Path, *, lab: str = "") -> None:
        """`lab` is the directory of the virtual fleet that is worked with, empty for real nodes."""
        self.path = path
        self.lab = lab
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._database = sqlite3.connect(
                path, timeout=BUSY_TIMEOUT_S, isolation_level=None, check_same_thread=False
            )
        except (OSError, sqlite3.Error) as error:
            raise MeshctlError(f"{path}: cannot open the journal: {error}", hint=_hint(error)) from error
        try:
            self._enter_wal()
            self._database.execute("PRAGMA synchronous = NORMAL")
            self._database.execute("PRAGMA foreign_keys = ON")
            self._create()
        except (sqlite3.Error, MeshctlError) as error:
            self._database.close()
            if isinstance(error, MeshctlError):
                raise
            what = "cannot open the journal" if _hint(error) else "not a journal of meshctl"
            hint = _hint(error) or "move the file away and run again"
            raise MeshctlError(f"{path}: {what}: {error}", hint=hint) from error

    def _enter_wal(self) -> None:
        # Two processes that create the file at once: SQLite answers "locked" here without waiting.
        deadline = time.monotonic() + BUSY_TIMEOUT_S
        while True:
            try:
                self._database.execute("PRAGMA journal_mode = WAL")
            except sqlite3.OperationalError as error:
                if not _is_locked(error) or time.monotonic() > deadline:
                    raise
                time.sleep(0.01)
            else:
                return

    def _create(self) -> None:
        # whoever only reads waits for no writer
        if self._version() == SCHEMA_VERSION:
            return
        with self._write() as database:
            version = self._version()
            if version == 0:
                for statement in _SCHEMA.split(";\n"):
                    if statement.strip():
                        database.execute(statement)
                database.execute(f"PRAGMA user_version = {SCHEMA_VERSION}")
            elif version != SCHEMA_VERSION:
                raise MeshctlError(f"{self.path}: journal of version {version}, expected {SCHEMA_VERSION}")

    def _version(self) -> int:
        return int(self._database.execute("PRAGMA user_version").fetchone()[0])

    @contextmanager
    def _write(self, wait_s: float = BUSY_TIMEOUT_S) -> Iterator[sqlite3.Connection]:
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
                # a COMMIT that found the disk full may have left its transaction open
                if self._database.in_transaction:
                    with suppress(sqlite3.Error):
                        self._database.execute("ROLLBACK")
                raise MeshctlError(f"{self.path}: cannot write the journal: {error}", hint=_hint(error)) from error

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        with self._lock:
            self._database.close()

    def begin(self, command: str, *, fleet: str, inventory: str, nodes: tuple[str, ...], plan: str = "") -> Run:
        """A new run; every node of it stands as PENDING until it has an outcome."""
        now = time.time()
        with self._write() as database:
            cursor = database.execute(
                "INSERT INTO runs (command, fleet, inventory, owner, process, plan, began_s)"
                " VALUES (?, ?, ?, ?, ?, ?, ?)",
                (command, self._key(fleet), inventory, owner(), this_process(), plan, now),
            )
            run_id = int(cursor.lastrowid or 0)
            database.executemany(
                "INSERT INTO outcomes (run, node, result, began_s) VALUES (?, ?, ?, ?)",
                [(run_id, node, Result.PENDING.value, now) for node in dict.fromkeys(nodes)],
            )
        return Run(self, run_id)

    def runs(
        self, *, fleet: str | None = None, node: str | None = None, limit: int | None = 20
    ) -> tuple[RunRecord, ...]:
        """The latest runs (of a fleet, with a node), newest first; `limit` None: all."""
        rows = self._read(
            f"SELECT {_RUN_COLUMNS} FROM runs WHERE (?1 IS NULL OR fleet = ?1)"
            " AND (?2 IS NULL OR EXISTS (SELECT 1 FROM outcomes WHERE run = id AND node = ?2))"
            " ORDER BY id DESC LIMIT ?3",
            (None if fleet is None else self._key(fleet), node, -1 if limit is None else limit),
        )
        return tuple(_record(row) for row in rows)

    def run(self, run_id: int) -> RunRecord | None:
        rows = self._read(f"SELECT {_RUN_COLUMNS} FROM runs WHERE id = ?", (run_id,))
        return _record(rows[0]) if rows else None

    def outcomes(self, run_id: int) -> tuple[Outcome, ...]:
        rows = self._read(
            "SELECT node, result, reason, duration_s, facts FROM outcomes WHERE run = ? ORDER BY rowid", (run_id,)
        )
        return tuple(
            Outcome(node, Result(result), reason, duration_s=duration, facts=json.loads(facts))
            for node, result, reason, duration, facts in rows
        )

    def steps(self, run_id: int, node: str | None = None) -> tuple[StepRecord, ...]:
        rows = self._read(
            "SELECT node, step, began_s, duration_s, result FROM steps WHERE run = ?1 AND (?2 IS NULL OR node = ?2)"
            " ORDER BY id",
            (run_id, node),
        )
        return tuple(StepRecord(*row) for row in rows)

    def unfinished(self, run_id: int) -> tuple[str, ...]:
        """The nodes of a run that a resume has to take up, in the run's order."""
        return tuple(outcome.node for outcome in self.outcomes(run_id) if not outcome.result.is_settled)

    def unfinished_runs(self, fleet: str) -> dict[int, tuple[str, ...]]:
        """Run -> the nodes that it left unfinished and no later run took up; the newest run first.

        Runs of `robots` and those of radios do not count as each other's successors.
        """
        rows = self._read(
            "SELECT run, node, outcomes.result FROM outcomes JOIN runs ON id = run WHERE fleet = ?1 AND NOT EXISTS"
            " (SELECT 1 FROM outcomes AS later JOIN runs AS after ON after.id = later.run WHERE after.fleet = ?1"
            " AND later.node = outcomes.node AND after.id > runs.id"
            " AND (after.command LIKE 'robots %') = (runs.command LIKE 'robots %'))"
            " ORDER BY run DESC, outcomes.rowid",
            (self._key(fleet),),
        )
        unfinished: dict[int, tuple[str, ...]] = {}
        for run_id, node, result in rows:
            if not Result(result).is_settled:
                unfinished[run_id] = (*unfinished.get(run_id, ()), node)
        return unfinished

    def unfinished_changes(self, fleet: str) -> dict[str, float]:
        """The nodes on which a change was begun that no run saw the end of, and when the first such was (Unix time)."""
        ended = ", ".join(f"'{result.value}'" for result in Result if result not in _END_UNKNOWN)
        rows = self._read(
            "SELECT node, MIN(steps.began_s) FROM steps JOIN runs ON runs.id = run WHERE fleet = ?1"
            " AND command NOT LIKE 'robots %' AND step IN ('apply', 'flash') AND NOT EXISTS"
            " (SELECT 1 FROM outcomes AS later JOIN runs AS after ON after.id = later.run WHERE after.fleet = ?1"
            " AND later.node = steps.node AND later.run >= steps.run AND after.command NOT LIKE 'robots %'"
            f" AND later.result IN ({ended})) GROUP BY node ORDER BY node",
            (self._key(fleet),),
        )
        return dict(rows)

    def remember(self, fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> None:
        """Keep what a node told; an older sighting never replaces a newer one."""
        self.remember_all(fleet, {node: facts}, seen_s)

    def remember_all(self, fleet: str, facts: Mapping[str, Mapping[str, str]], seen_s: float) -> None:
        with self._write() as database:
            database.executemany(
                _REMEMBER, [_sighting(self._key(fleet), node, known, seen_s) for node, known in facts.items()]
            )

    def last_known(self, fleet: str) -> dict[str, LastKnown]:
        rows = self._read("SELECT node, seen_s, facts FROM nodes WHERE fleet = ? ORDER BY node", (self._key(fleet),))
        return {node: LastKnown(node, seen_s, json.loads(facts)) for node, seen_s, facts in rows}

    def move_lab_runs(self, fleet: str, lab_of: Callable[[str], str]) -> None:
        """Give each lab its runs of `fleet` that an earlier version kept under the real fleet's name.

        `lab_of` gives the lab's directory by a run's inventory, empty for a real one. What was known of the nodes goes
        along if all runs were one lab's; otherwise its origin is unknown, and it stays.
        """
        rows = self._read("SELECT DISTINCT inventory FROM runs WHERE fleet = ?", (fleet,))
        labs = {inventory: lab_of(inventory) for (inventory,) in rows}
        moving = {inventory: lab for inventory, lab in labs.items() if lab}
        if not moving:
            return
        with self._write() as database:
            for inventory, lab in moving.items():
                new = _key_of(fleet, lab)
                database.execute("UPDATE runs SET fleet = ? WHERE fleet = ? AND inventory = ?", (new, fleet, inventory))
            if len(set(labs.values())) == 1:
                new = _key_of(fleet, next(iter(moving.values())))
                database.execute("UPDATE OR IGNORE nodes SET fleet = ? WHERE fleet = ?", (new, fleet))

    def _key(self, fleet: str) -> str:
        return _key_of(fleet, self.lab)

    def _read(self, query: str, values: tuple[object, ...]) -> list[tuple[Any, ...]]:
        with self._lock:
            try:
                return self._database.execute(query, values).fetchall()
            except sqlite3.Error as error:
                raise MeshctlError(f"{self.path}: cannot read the journal: {error}") from error


class Run:
    """One run being written. Steps and outcomes may come from several threads.

    A journal that cannot be written (a full disk, another process that holds it) stops no work on nodes: a change that
    is armed has to be confirmed. What it does not take is kept, and written with what comes next.
    """

    def __init__(self, journal: Journal, run_id: int) -> None:
        self._journal = journal
        self._guard = threading.Lock()
        self._pending: list[tuple[str, tuple[object, ...]]] = []
        self.id = run_id
        # why the journal lacks something; what it lacks counts as not done to a resume
        self.error = ""

    def _put(self, statement: str, *values: object, wait_s: float = STEP_TIMEOUT_S) -> None:
        with self._guard:
            # whoever could not write waits no second time before the end
            timeout_s = 0.0 if self._pending and wait_s <= STEP_TIMEOUT_S else wait_s
            self._pending.append((statement, values))
            try:
                with self._journal._write(timeout_s) as database:
                    for pending in self._pending:
                        database.execute(*pending)
            except MeshctlError as error:
                self.error = str(error)
            else:
                self._pending.clear()
                self.error = ""

    def remember(self, fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> None:
        """Keep what a node told in the course of this run."""
        self._put(_REMEMBER, *_sighting(self._journal._key(fleet), node, facts, seen_s))

    @contextmanager
    def step(self, node: str, name: str) -> Iterator[None]:
        """Record a step and how long it took; a step without an end was cut short by our own death."""
        began_s, clock = time.time(), time.monotonic()
        key = (self.id, node, name, began_s)
        self._put("INSERT INTO steps (run, node, step, began_s) VALUES (?, ?, ?, ?)", *key)
        result = "done"
        try:
            yield
        except BaseException as error:
            result = f"failed: {error}" if isinstance(error, MeshctlError) else f"failed: {type(error).__name__}"
            raise
        finally:
            took_s = round(time.monotonic() - clock, 3)
            self._put(
                "UPDATE steps SET duration_s = ?, result = ? WHERE run = ? AND node = ? AND step = ? AND began_s = ?",
                *(took_s, result, *key),
            )

    def finish_node(self, outcome: Outcome) -> None:
        self._put(
            "INSERT INTO outcomes (run, node, result, reason, began_s, duration_s, facts)"
            " VALUES (?1, ?2, ?3, ?4, ?5, ?6, ?7) ON CONFLICT (run, node)"
            " DO UPDATE SET result = ?3, reason = ?4, duration_s = ?6, facts = ?7",
            *(self.id, outcome.node, outcome.result.value, outcome.reason),
            *(time.time() - outcome.duration_s, outcome.duration_s, json.dumps(dict(outcome.facts), sort_keys=True)),
        )

    def end(self, result: str) -> None:
        ended = (time.time(), result, self.id)
        self._put("UPDATE runs SET ended_s = ?, result = ? WHERE id = ?", *ended, wait_s=BUSY_TIMEOUT_S)


def _key_of(fleet: str, lab: str) -> str:
    """What the tables have as a fleet. A fleet's name holds no control character, so the parts cannot be confused."""
    return f"{fleet}{_LAB_SEPARATOR}{lab}" if lab else fleet


def _record(row: tuple[Any, ...]) -> RunRecord:
    record = RunRecord(*row)
    fleet, _, lab = record.fleet.partition(_LAB_SEPARATOR)
    return replace(record, fleet=fleet, lab=lab)


def _sighting(fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> tuple[object, ...]:
    return fleet, node, seen_s, json.dumps(dict(facts), sort_keys=True)


# SQLite's primary result codes (sqlite.org/rescode.html); the bits above these eight tell more about the same.
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


def _hint(error: Exception) -> str:
    """What to do when the file cannot be used; empty when the file itself is at fault."""
    if _is_locked(error):
        return "another process holds it: `fuser` with its path names that process"
    if isinstance(error, OSError) or _primary(error) in _UNWRITABLE:
        return "XDG_STATE_HOME=DIR keeps it elsewhere, on a disk with room that can be written"
    return ""


def default_path(environ: Mapping[str, str]) -> Path:
    """`$XDG_STATE_HOME/meshctl/journal.sqlite`, by default under ~/.local/state (XDG Base Directory 0.8)."""
    state = environ.get("XDG_STATE_HOME", "")
    root = Path(state) if state.startswith("/") else Path(environ.get("HOME", "~")).expanduser() / ".local" / "state"
    return root / "meshctl" / "journal.sqlite"
