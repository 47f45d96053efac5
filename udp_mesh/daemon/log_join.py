"""Adds the logs of one database to another: what was kept in memory while the disk's database was locked.

The database on disk keeps its identity: its numbers were not used, since only the holder of its lock uses them. The own
items of the meantime stay in a log of their own, as those from before a lost disk do.
"""

from __future__ import annotations

import json
import sqlite3

from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import as_set
from udp_mesh.core.logs.messages import Ranges
from udp_mesh.core.logs.store import ItemUse, RememberedLog
from udp_mesh.daemon.log_rows import parse_ranges


def join_logs(memory: sqlite3.Connection, disk: sqlite3.Connection) -> int:
    """Adds all logs in one transaction; returns the number of items that were on the disk. Raises sqlite3.Error, and
    then changes nothing."""
    (earlier,) = disk.execute("SELECT count(*) FROM items").fetchone()
    disk.execute("BEGIN IMMEDIATE")
    try:
        for log, *key, dropped in memory.execute("SELECT id, topic, source, log_id, dropped FROM logs").fetchall():
            _join_log(memory, disk, log, LogKey(*key), dropped)
        disk.execute("COMMIT")
    except BaseException:
        disk.execute("ROLLBACK")
        raise
    return int(earlier)


def _join_log(memory: sqlite3.Connection, disk: sqlite3.Connection, log: int, key: LogKey, dropped: str) -> None:
    number = log_number(disk, key)
    carried = memory.execute("SELECT ranges FROM carried WHERE log = ?", (log,)).fetchone()
    remembered = RememberedLog(key, parse_ranges(dropped) or (), parse_ranges(carried[0]) or () if carried else ())
    remember(disk, number, with_earlier(disk, number, remembered))
    items = memory.execute("SELECT number, data, stored_s, taken FROM items WHERE log = ? ORDER BY position", (log,))
    for item in items:
        disk.execute(
            "INSERT INTO items (log, number, data, stored_s, taken) VALUES (?, ?, ?, ?, ?)"
            " ON CONFLICT (log, number) DO UPDATE SET taken = excluded.taken WHERE excluded.taken = ?",
            (number, *item, int(ItemUse.TAKEN)),
        )


def with_earlier(connection: sqlite3.Connection, log: int, remembered: RememberedLog) -> RememberedLog:
    """The record of a log, merged with the one in the database."""
    (received,) = connection.execute("SELECT dropped FROM logs WHERE id = ?", (log,)).fetchone()
    carried = connection.execute("SELECT ranges FROM carried WHERE log = ?", (log,)).fetchone()
    return RememberedLog(
        remembered.log,
        _union(remembered.received, parse_ranges(received)),
        _union(remembered.carried, parse_ranges(carried[0]) if carried else None),
    )


def remember(connection: sqlite3.Connection, log: int, remembered: RememberedLog) -> None:
    """Replaces what is remembered of a log."""
    connection.execute("UPDATE logs SET dropped = ? WHERE id = ?", (_json(remembered.received), log))
    if remembered.carried:
        values = (log, _json(remembered.carried))
        connection.execute("INSERT OR REPLACE INTO carried (log, ranges) VALUES (?, ?)", values)
    else:
        connection.execute("DELETE FROM carried WHERE log = ?", (log,))


def log_number(connection: sqlite3.Connection, key: LogKey) -> int:
    """The row of a log, which is added if there is none."""
    row = connection.execute(
        "SELECT id FROM logs WHERE topic = ? AND source = ? AND log_id = ?", (key.topic, key.source, key.log_id)
    ).fetchone()
    if row is None:
        row = connection.execute(
            "INSERT INTO logs (topic, source, log_id) VALUES (?, ?, ?) RETURNING id",
            (key.topic, key.source, key.log_id),
        ).fetchone()
    return int(row[0])


def _union(some: Ranges, others: Ranges | None) -> Ranges:
    return tuple(as_set([*some, *(others or ())]).ranges())


def _json(ranges: Ranges) -> str:
    return json.dumps(ranges, separators=(",", ":"))
