"""The tables of the journal's file on one computer, and the statement that stores what was last seen of a node.

The tables of a journal in PostgreSQL are in `fleet.postgresql`; they have the same columns.
"""

from __future__ import annotations

from meshctl.fleet.sqlite_file import Schema

# separates the name of a fleet and the directory of its lab (ASCII unit separator)
LAB_SEPARATOR = "\x1f"
SCHEMA = Schema(
    name="journal",
    version=1,
    space_hint="set XDG_STATE_HOME to a directory on a writable disk with free space",
    statements="""
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
""",
)
REMEMBER = (
    "INSERT INTO nodes (fleet, node, seen_s, facts) VALUES (?1, ?2, ?3, ?4) ON CONFLICT (fleet, node)"
    " DO UPDATE SET seen_s = ?3, facts = ?4 WHERE ?3 >= nodes.seen_s"
)
