"""The rows of the database of shared logs -> what the store held, checked.

SQLite takes any value in any column, and a file may have been changed by hand. A row that makes no sense is left
out and reported; all others are kept. Numbers in a row are never underestimated: if
the numbers that this node used are in doubt, its logs get a new identity, as after the loss of a disk.
"""

from __future__ import annotations

import json
import math
import os
import sqlite3
from dataclasses import dataclass, field
from functools import partial

from udp_mesh.core.logs.item import FIRST_NUMBER, MAX_NUMBER, ItemId, LogKey
from udp_mesh.core.logs.knowledge import as_set
from udp_mesh.core.logs.messages import Ranges
from udp_mesh.core.logs.store import ItemUse, LogContents, RememberedLog, StoredItem
from udp_mesh.crypto.signing import PUBLIC_KEY_BYTES, SEED_BYTES, SigningKey
from udp_mesh.wire.limits import MAX_LOG_TOPIC_BYTES, MAX_NAME_BYTES

SCHEMA = """
CREATE TABLE IF NOT EXISTS meta (name TEXT PRIMARY KEY, value BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS logs (
    id INTEGER PRIMARY KEY, topic TEXT NOT NULL, source TEXT NOT NULL, log_id BLOB NOT NULL,
    dropped TEXT NOT NULL DEFAULT '[]', UNIQUE (topic, source, log_id));
CREATE TABLE IF NOT EXISTS items (
    position INTEGER PRIMARY KEY AUTOINCREMENT, log INTEGER NOT NULL REFERENCES logs (id), number INTEGER NOT NULL,
    data BLOB NOT NULL, stored_s REAL NOT NULL, taken INTEGER NOT NULL, UNIQUE (log, number));
CREATE TABLE IF NOT EXISTS carried (log INTEGER PRIMARY KEY REFERENCES logs (id), ranges TEXT NOT NULL);
"""
"""`items.taken` is an `ItemUse`: a daemon that knows no 2 takes what was only carried for taken. `dropped` and `ranges`
are JSON lists of [first, last]."""

FIRST_PLAUSIBLE_S = 1_704_067_200.0
"""2024-01-01: a computer without a battery-backed clock starts long before, until it is set."""
MAX_PROBLEMS = 20
"""Problems that are reported one by one."""


@dataclass(slots=True)
class LoadedRows:
    """The rows that were read. `orphans` are items that no row assigns to a log."""

    contents: LogContents
    problems: list[str]
    problem_count: int
    orphans: int
    new_identity: bool


@dataclass(slots=True)
class _Reader:
    """The logs whose rows are sound, by row id."""

    keys: dict[int, LogKey] = field(default_factory=dict)
    received: dict[int, Ranges] = field(default_factory=dict)
    carried: dict[int, Ranges] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    problem_count: int = 0
    doubtful: set[int] = field(default_factory=set)
    """Logs of which not all numbers are known that they used."""

    def report(self, problem: str) -> None:
        self.problem_count += 1
        if len(self.problems) < MAX_PROBLEMS:
            self.problems.append(problem)


def load_rows(connection: sqlite3.Connection, now: float) -> LoadedRows:
    """Read a database with this schema; `now` is Unix time in seconds. Writes the seed of a new identity if there is
    none or the old one cannot be used any longer. Raises sqlite3.Error."""
    rows = _Reader()
    # A text that is not UTF-8 would otherwise end the whole query.
    connection.text_factory = partial(str, encoding="utf-8", errors="surrogateescape")
    connection.execute("INSERT OR IGNORE INTO meta VALUES ('seed', ?)", (os.urandom(SEED_BYTES),))
    (seed,) = connection.execute("SELECT value FROM meta WHERE name = 'seed'").fetchone()
    is_seed = isinstance(seed, bytes) and len(seed) == SEED_BYTES
    if not is_seed:
        rows.report(f"meta.seed: expected {SEED_BYTES} bytes, found {_shown(seed)}")
    _read_logs(connection, rows)
    own = SigningKey(seed).public if is_seed else None
    items, orphans = _read_items(connection, rows, own, now)
    new_identity = own is None or any(rows.keys[log].log_id == own for log in rows.doubtful if log in rows.keys)
    if new_identity:
        seed = os.urandom(SEED_BYTES)
        connection.execute("UPDATE meta SET value = ? WHERE name = 'seed'", (seed,))
    remembered = tuple(
        RememberedLog(key, rows.received.get(log, ()), rows.carried.get(log, ()))
        for log, key in rows.keys.items()
        if rows.received.get(log) or rows.carried.get(log)
    )
    contents = LogContents(seed, items, remembered)
    return LoadedRows(contents, rows.problems, rows.problem_count, orphans, new_identity)


def _read_logs(connection: sqlite3.Connection, rows: _Reader) -> None:
    for log, topic, source, log_id, dropped in connection.execute(
        "SELECT id, topic, source, log_id, dropped FROM logs"
    ):
        if not (
            _is_name(topic, MAX_LOG_TOPIC_BYTES)
            and _is_name(source, MAX_NAME_BYTES)
            and isinstance(log_id, bytes)
            and len(log_id) == PUBLIC_KEY_BYTES
        ):
            found = f"{_shown(topic)}, {_shown(source)} and {_shown(log_id)}"
            rows.report(f"logs row {log}: expected a topic, a source and {PUBLIC_KEY_BYTES} bytes, found {found}")
            rows.keys.pop(log, None)
            continue
        rows.keys[log] = LogKey(topic, source, log_id)
        ranges = parse_ranges(dropped)
        if ranges is None:
            rows.report(f"logs row {log}: dropped: expected ascending ranges, found {_shown(dropped)}")
            rows.doubtful.add(log)
        else:
            rows.received[log] = ranges
    for log, text in connection.execute("SELECT log, ranges FROM carried"):
        ranges = parse_ranges(text)
        if ranges is None:
            rows.report(f"carried row {log}: expected ascending ranges, found {_shown(text)}")
        else:
            rows.carried[log] = ranges


def _read_items(
    connection: sqlite3.Connection, rows: _Reader, own: bytes | None, now: float
) -> tuple[tuple[StoredItem, ...], int]:
    known = {log for (log,) in connection.execute("SELECT id FROM logs")}
    items, orphans = list[StoredItem](), 0
    for position, log, number, kind, size, stored_s, taken in connection.execute(
        "SELECT position, log, number, typeof(data), length(data), stored_s, taken FROM items ORDER BY position"
    ):
        if log not in known:
            orphans += 1
        if log not in rows.keys:
            continue
        if not isinstance(number, int) or not FIRST_NUMBER <= number <= MAX_NUMBER:
            rows.report(f"items row {position}: expected a number of {FIRST_NUMBER} to {MAX_NUMBER}, found {number!r}")
            rows.doubtful.add(log)
        elif kind != "blob" or not _is_time(stored_s) or not _is_use(taken):
            found = f"{kind}, {_shown(stored_s)} and {_shown(taken)}"
            rows.report(f"items row {position}: expected data, a time and a use, found {found}")
            if rows.keys[log].log_id == own:
                # Others may have the item: its number is used.
                rows.received[log] = tuple(as_set([*rows.received.get(log, ()), (number, number)]).ranges())
        else:
            age_s = _age_s(float(stored_s), now)
            items.append(StoredItem(ItemId(rows.keys[log], number), size, age_s, ItemUse(taken)))
    return tuple(items), orphans


def parse_ranges(text: object) -> Ranges | None:
    """The ranges in a JSON list. None if it is none."""
    try:
        pairs = json.loads(text) if isinstance(text, str) else None
    except (ValueError, RecursionError):
        return None
    if not isinstance(pairs, list):
        return None
    ranges: list[tuple[int, int]] = []
    floor = FIRST_NUMBER
    for pair in pairs:
        if not (isinstance(pair, list) and len(pair) == 2 and all(type(number) is int for number in pair)):
            return None
        first, last = pair
        if not floor <= first <= last <= MAX_NUMBER:
            return None
        ranges.append((first, last))
        floor = last + 1
    return tuple(ranges)


def _is_name(value: object, max_bytes: int) -> bool:
    try:
        return isinstance(value, str) and 0 < len(value.encode()) <= max_bytes
    except UnicodeEncodeError:
        return False


def _is_time(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _is_use(value: object) -> bool:
    return isinstance(value, int) and value in tuple(ItemUse)


def _age_s(stored_s: float, now: float) -> float:
    """Time since an item was stored; 0 if the wall clock was not set then, or was set back since."""
    return max(0.0, now - stored_s) if stored_s >= FIRST_PLAUSIBLE_S else 0.0


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
