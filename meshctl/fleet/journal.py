"""The journal: runs, steps, outcomes, and the last known state of every node, on disk.

A `Store`: one SQLite file in `$XDG_STATE_HOME/meshctl` (WAL, so that two meshctl processes can write and a killed one
leaves it readable), or a database that operators share (`fleet.journal_store` opens either). `Journal.begin` starts a
run; `Run.step`, `Run.finish_node` and `Run.end` fill it; `runs`, `steps`, `outcomes`, `unfinished` and `last_known`
read it. It contains no secret.

A lab's fleet has the same name and nodes as the real one. Their runs and facts are separate: a journal opened for a lab
reads and writes under the fleet's name and the lab's directory.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from meshctl.errors import MeshctlError
from meshctl.fleet.alarm_actions import AlarmExchange
from meshctl.fleet.journal_schema import LAB_SEPARATOR, REMEMBER, SCHEMA
from meshctl.fleet.outcome import Outcome, Result
from meshctl.fleet.process import is_process_alive, owner, runs_here, this_process
from meshctl.fleet.sqlite_file import BUSY_TIMEOUT_S, SqliteFile
from meshctl.fleet.store import Claim, Statement, Store

# During a run nodes wait to be confirmed, so a locked journal is written later.
STEP_TIMEOUT_S = 1.0
# Keys of facts: those that every command stores have the node's name alone, those of `status` a prefix.
NODE_PREFIX = "status."
ROBOT_PREFIX = "robot."
# The fact that tells which device the others are of: the host keys that were pinned for it.
_HOST_KEYS = "host_keys"
# more than any journal has: PostgreSQL has no LIMIT -1, SQLite no LIMIT NULL
_ALL_RUNS = 2**62
_RUN_COLUMNS = "id, command, fleet, inventory, owner, process, plan, began_s, ended_s, result"
# Outcomes that leave the result of an earlier change unknown.
_END_UNKNOWN = (Result.UNCERTAIN, Result.PENDING, Result.UNREACHABLE)


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run; `result` is empty while it is in progress."""

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
    is_connected: bool | None = None
    """Whether its process is connected to the shared journal; None for a journal of one computer."""

    @property
    def is_over(self) -> bool:
        return self.ended_s is not None or not is_process_alive(self.process)

    @property
    def state(self) -> str:
        if self.ended_s is not None:
            return self.result
        if not is_process_alive(self.process):
            return "interrupted"
        is_here = runs_here(self.process)
        return "under way" if is_here or self.is_connected is not False else "under way, or interrupted: out of contact"


@dataclass(frozen=True, slots=True)
class StepRecord:
    node: str
    step: str
    began_s: float
    duration_s: float | None
    result: str


@dataclass(frozen=True, slots=True)
class LastKnown:
    """The facts of a node when it was last seen, at `seen_s` (Unix time)."""

    node: str
    seen_s: float
    facts: Mapping[str, str]


class Journal:
    """The journal file. Safe for several threads and processes; close it, or use a `with` block."""

    def __init__(
        self,
        store: Path | Store,
        *,
        lab: str = "",
        pinned: Callable[[str], Iterable[str]] = lambda node: (),
        merge_later: Callable[[int], None] = lambda run: None,
    ) -> None:
        """`store` is the database, or the path of the file on this computer. `lab` is the directory of a virtual fleet,
        empty for real nodes; `pinned` are the fingerprints of the host keys pinned for a node: facts of a device with
        other keys, which has been replaced since, are left out. `merge_later` is called with each run that
        belongs in another journal, which is out of reach, and with 0 for facts without a run."""
        self.lab = lab
        self._pinned = pinned
        self._merge_later = merge_later
        self._store = SqliteFile(store, SCHEMA) if isinstance(store, Path) else store
        self.path = self._store.path

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        self._store.close()

    def begin(self, command: str, *, fleet: str, inventory: str, nodes: tuple[str, ...], plan: str = "") -> Run:
        """Start a run; each of its nodes is PENDING until it has an outcome."""
        now = time.time()
        with self._store.write(BUSY_TIMEOUT_S) as database:
            row = database.execute(
                "INSERT INTO runs (command, fleet, inventory, owner, process, plan, began_s)"
                " VALUES (?, ?, ?, ?, ?, ?, ?) RETURNING id",
                (command, self._key(fleet), inventory, owner(), this_process(), plan, now),
            ).fetchone()
            run_id = int(row[0])
            database.executemany(
                "INSERT INTO outcomes (run, node, result, began_s) VALUES (?, ?, ?, ?)",
                [(run_id, node, Result.PENDING.value, now) for node in dict.fromkeys(nodes)],
            )
        self._merge_later(run_id)
        return Run(self, run_id)

    def claim(self, run_id: int, fleet: str, nodes: Iterable[str]) -> tuple[Claim, ...]:
        """Claim nodes for a run, where operators share the journal; returns those that another run is changing, and
        claims none then."""
        return self._store.claim(self._key(fleet), tuple(nodes), run_id)

    def alarm_exchange(self, fleet: str) -> AlarmExchange | None:
        """How operators share what they do about alarms; None where only this computer writes."""
        return AlarmExchange(self._store, self._key(fleet)) if self._store.is_shared else None

    @property
    def notice(self) -> str:
        """A note for the operator about entries that are not in the journal's database; empty if all are."""
        return self._store.notice

    def wait_for_change(self, timeout_s: float) -> bool:
        """Wait until another process has written, or the time is over; whether something may have changed."""
        return self._store.wait_for_change(timeout_s)

    def runs(
        self, *, fleet: str | None = None, node: str | None = None, limit: int | None = 20
    ) -> tuple[RunRecord, ...]:
        """The latest runs (of a fleet, with a node), newest first; `limit` None: all."""
        rows = self._store.read(
            f"SELECT {_RUN_COLUMNS} FROM runs WHERE (?1 IS NULL OR fleet = ?1)"
            " AND (?2 IS NULL OR EXISTS (SELECT 1 FROM outcomes WHERE run = id AND node = ?2))"
            " ORDER BY id DESC LIMIT ?3",
            (None if fleet is None else self._key(fleet), node, _ALL_RUNS if limit is None else limit),
        )
        return self._records(rows)

    def run(self, run_id: int) -> RunRecord | None:
        records = self._records(self._store.read(f"SELECT {_RUN_COLUMNS} FROM runs WHERE id = ?", (run_id,)))
        return records[0] if records else None

    def _records(self, rows: Iterable[tuple[Any, ...]]) -> tuple[RunRecord, ...]:
        records = tuple(_record(row) for row in rows)
        if all(record.ended_s is not None for record in records):
            return records
        connected = self._store.connected_runs()
        return tuple(
            replace(record, is_connected=None if connected is None else record.id in connected) for record in records
        )

    def outcomes(self, run_id: int) -> tuple[Outcome, ...]:
        rows = self._store.read(
            "SELECT node, result, reason, duration_s, facts FROM outcomes WHERE run = ? ORDER BY rowid", (run_id,)
        )
        return tuple(
            Outcome(node, Result(result), reason, duration_s=duration, facts=json.loads(facts))
            for node, result, reason, duration, facts in rows
        )

    def steps(self, run_id: int, node: str | None = None) -> tuple[StepRecord, ...]:
        rows = self._store.read(
            "SELECT node, step, began_s, duration_s, result FROM steps WHERE run = ?1 AND (?2 IS NULL OR node = ?2)"
            " ORDER BY id",
            (run_id, node),
        )
        return tuple(StepRecord(*row) for row in rows)

    def unfinished(self, run_id: int) -> tuple[str, ...]:
        """The nodes of a run that a resume has to finish, in the run's order."""
        return tuple(outcome.node for outcome in self.outcomes(run_id) if not outcome.result.is_settled)

    def unfinished_runs(self, fleet: str) -> dict[int, tuple[str, ...]]:
        """Run -> the nodes that it left unfinished and that are in no later run; the newest run first.

        Runs of `robots` and runs of radios are separate.
        """
        rows = self._store.read(
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
        """Node -> when its first change started (Unix time) whose end no run has observed."""
        return self._unfinished(fleet, "MIN", "'apply', 'flash'")

    def latest_unfinished(self, fleet: str, step: Literal["apply", "flash"]) -> dict[str, float]:
        """Node -> when its latest step of this kind started (Unix time) whose end no run has observed."""
        return self._unfinished(fleet, "MAX", f"'{step}'")

    def _unfinished(self, fleet: str, pick: str, steps: str) -> dict[str, float]:
        ended = ", ".join(f"'{result.value}'" for result in Result if result not in _END_UNKNOWN)
        rows = self._store.read(
            f"SELECT node, {pick}(steps.began_s) FROM steps JOIN runs ON runs.id = run WHERE fleet = ?1"
            f" AND command NOT LIKE 'robots %' AND step IN ({steps}) AND NOT EXISTS"
            " (SELECT 1 FROM outcomes AS later JOIN runs AS after ON after.id = later.run WHERE after.fleet = ?1"
            " AND later.node = steps.node AND later.run >= steps.run AND after.command NOT LIKE 'robots %'"
            f" AND later.result IN ({ended})) GROUP BY node ORDER BY node",
            (self._key(fleet),),
        )
        return dict(rows)

    def change_durations_s(self, fleet: str, *, limit: int = 100) -> tuple[float, ...]:
        """How long the latest confirmed changes of one node's files took, from staging to the proof."""
        rows = self._store.read(
            "SELECT SUM(steps.duration_s) FROM steps JOIN runs ON runs.id = steps.run"
            " JOIN outcomes ON outcomes.run = steps.run AND outcomes.node = steps.node"
            " WHERE fleet = ?1 AND command NOT LIKE 'robots %' AND outcomes.result = ?2"
            " AND step IN ('stage', 'arm', 'apply', 'prove') GROUP BY steps.run, steps.node"
            " HAVING SUM(CASE WHEN step = 'prove' THEN 1 ELSE 0 END) = 1 ORDER BY steps.run DESC LIMIT ?3",
            (self._key(fleet), Result.DONE.value, limit),
        )
        return tuple(duration_s for (duration_s,) in rows)

    def remember(self, fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> None:
        """Store the facts of a node; older facts never replace newer ones."""
        self.remember_all(fleet, {node: facts}, seen_s)

    def remember_all(self, fleet: str, facts: Mapping[str, Mapping[str, str]], seen_s: float) -> None:
        sightings = [
            _sighting(self._key(fleet), node, self._marked(node, each), seen_s) for node, each in facts.items()
        ]
        self._store.put([(REMEMBER, values) for values in sightings], BUSY_TIMEOUT_S)
        self._merge_later(0)

    def last_known(self, fleet: str) -> dict[str, LastKnown]:
        rows = self._store.read(
            "SELECT node, seen_s, facts FROM nodes WHERE fleet = ? ORDER BY node", (self._key(fleet),)
        )
        found: dict[str, LastKnown] = {}
        for node, seen_s, text in rows:
            facts = json.loads(text)
            keys, pinned = set(facts.pop(_HOST_KEYS, "").split()), set(self._keys_of(node))
            if not (keys and pinned and keys.isdisjoint(pinned)):
                found[node] = LastKnown(node, seen_s, facts)
        return found

    def _keys_of(self, node: str) -> tuple[str, ...]:
        """The host keys pinned for a radio now."""
        return () if node.startswith(ROBOT_PREFIX) else tuple(self._pinned(node.removeprefix(NODE_PREFIX)))

    def _marked(self, node: str, facts: Mapping[str, str]) -> dict[str, str]:
        """The facts, with the host keys of the device that they are of."""
        keys = " ".join(self._keys_of(node))
        return {**facts, **({_HOST_KEYS: keys} if keys else {})}

    def move_lab_runs(self, fleet: str, lab_of: Callable[[str], str]) -> None:
        """Move each lab's runs of `fleet`, which an earlier version stored under the real fleet's name, to the lab.

        `lab_of` maps a run's inventory to the lab's directory, empty for a real fleet. The nodes' facts move only if
        all runs are of one lab; otherwise their origin is unknown.
        """
        rows = self._store.read("SELECT DISTINCT inventory FROM runs WHERE fleet = ?", (fleet,))
        labs = {inventory: lab_of(inventory) for (inventory,) in rows}
        moving = {inventory: lab for inventory, lab in labs.items() if lab}
        if not moving:
            return
        with self._store.write(BUSY_TIMEOUT_S) as database:
            for inventory, lab in moving.items():
                new = _key_of(fleet, lab)
                database.execute("UPDATE runs SET fleet = ? WHERE fleet = ? AND inventory = ?", (new, fleet, inventory))
            if len(set(labs.values())) == 1:
                new = _key_of(fleet, next(iter(moving.values())))
                database.execute("UPDATE OR IGNORE nodes SET fleet = ? WHERE fleet = ?", (new, fleet))

    def _key(self, fleet: str) -> str:
        return _key_of(fleet, self.lab)


class Run:
    """Writes one run; steps and outcomes may come from several threads.

    A journal that cannot be written (a full disk, a lock) does not stop the work on nodes, because an armed change has
    to be confirmed. Failed writes are kept and repeated with the next one.
    """

    def __init__(self, journal: Journal, run_id: int) -> None:
        self._journal = journal
        self._guard = threading.Lock()
        self._pending: list[Statement] = []
        self.id = run_id
        # why the journal is incomplete; a resume treats missing outcomes as not done
        self.error = ""

    def _put(self, statement: str, *values: object, wait_s: float = STEP_TIMEOUT_S) -> None:
        with self._guard:
            # after a failed write, do not wait again before the end
            timeout_s = 0.0 if self._pending and wait_s <= STEP_TIMEOUT_S else wait_s
            self._pending.append((statement, values))
            try:
                self._journal._store.put(self._pending, timeout_s)
            except MeshctlError as error:
                self.error = str(error)
            else:
                self._pending.clear()
                self.error = ""

    def remember(self, fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> None:
        """Store the facts of a node during this run."""
        marked = self._journal._marked(node, facts)
        self._put(REMEMBER, *_sighting(self._journal._key(fleet), node, marked, seen_s))

    @contextmanager
    def step(self, node: str, name: str) -> Iterator[None]:
        """Record a step and its duration; a step without an end was cut short by the end of our process."""
        began_s, clock = time.time(), time.monotonic()
        key = (self.id, node, name, began_s)
        self._put("INSERT INTO steps (run, node, step, began_s) VALUES (?, ?, ?, ?) ON CONFLICT DO NOTHING", *key)
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
    """The value of the tables' `fleet` column. A fleet name has no control character, so the parts are unambiguous."""
    return f"{fleet}{LAB_SEPARATOR}{lab}" if lab else fleet


def _record(row: tuple[Any, ...]) -> RunRecord:
    record = RunRecord(*row)
    fleet, _, lab = record.fleet.partition(LAB_SEPARATOR)
    return replace(record, fleet=fleet, lab=lab)


def _sighting(fleet: str, node: str, facts: Mapping[str, str], seen_s: float) -> tuple[object, ...]:
    return fleet, node, seen_s, json.dumps(dict(facts), sort_keys=True)


def default_path(environ: Mapping[str, str]) -> Path:
    """`$XDG_STATE_HOME/meshctl/journal.sqlite`, by default under ~/.local/state (XDG Base Directory 0.8)."""
    state = environ.get("XDG_STATE_HOME", "")
    root = Path(state) if state.startswith("/") else Path(environ.get("HOME", "~")).expanduser() / ".local" / "state"
    return root / "meshctl" / "journal.sqlite"
