"""A PostgreSQL database as a journal for several operators: connection, tables and their migrations, claims, changes.

`Database` connects and brings the tables up to date; `read` and `transaction` translate the journal's statements;
`lock_nodes`, `lock_run` and `connected_runs` are about advisory locks of this session, which end with it;
`wait_for_change` listens for the notification that every transaction of the journal sends. Every error is a
MeshctlError, and a lost connection is a `DatabaseLost`. The password never appears in a message.

Needs psycopg 3 (the extra `postgresql`), and PostgreSQL 12 or newer. Docs: postgresql.org/docs/current, "Explicit
Locking" for advisory locks, "NOTIFY", and "Database Connection Control Functions" for the parameters of a connection.
"""

from __future__ import annotations

import hashlib
import os
import re
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

from meshctl.deadline import deadline
from meshctl.errors import InputError, MeshctlError

if TYPE_CHECKING:
    import psycopg

CONNECT_TIMEOUT_S = 3
# unacknowledged data for so long means that the connection is lost: a run waits no longer than this, once
SILENCE_TIMEOUT_MS = 4000
# a statement or a lock of the database that takes longer is given up by the server
STATEMENT_TIMEOUT_MS = 5_000
# and if the server itself hangs, by us
ANSWER_TIMEOUT_S = 8.0
CHANNEL = "meshctl"
_SCHEMES = ("postgresql://", "postgres://")
# the first key of advisory locks of runs: "mesh" in ASCII; those of nodes have one key of 64 bits
_RUN_LOCKS = 0x6D657368
# One entry for each version of the tables, from nothing on. Never change one that was released: add another.
MIGRATIONS = (
    """
CREATE TABLE runs (
    id BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, command TEXT NOT NULL, fleet TEXT NOT NULL,
    inventory TEXT NOT NULL, owner TEXT NOT NULL, process TEXT NOT NULL, plan TEXT NOT NULL,
    began_s DOUBLE PRECISION NOT NULL, ended_s DOUBLE PRECISION, result TEXT NOT NULL DEFAULT '', origin TEXT UNIQUE
);
CREATE TABLE outcomes (
    rowid BIGINT GENERATED ALWAYS AS IDENTITY, run BIGINT NOT NULL REFERENCES runs(id), node TEXT NOT NULL,
    result TEXT NOT NULL, reason TEXT NOT NULL DEFAULT '', began_s DOUBLE PRECISION NOT NULL,
    duration_s DOUBLE PRECISION NOT NULL DEFAULT 0, facts TEXT NOT NULL DEFAULT '{}', PRIMARY KEY (run, node)
);
CREATE TABLE steps (
    id BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, run BIGINT NOT NULL REFERENCES runs(id), node TEXT NOT NULL,
    step TEXT NOT NULL, began_s DOUBLE PRECISION NOT NULL, duration_s DOUBLE PRECISION,
    result TEXT NOT NULL DEFAULT '', UNIQUE (run, node, step, began_s)
);
CREATE TABLE nodes (
    fleet TEXT NOT NULL, node TEXT NOT NULL, seen_s DOUBLE PRECISION NOT NULL, facts TEXT NOT NULL,
    PRIMARY KEY (fleet, node)
);
CREATE INDEX outcomes_of_node ON outcomes(node, run);
CREATE INDEX runs_of_fleet ON runs(fleet, id);
""",
    """
CREATE TABLE alarm_actions (
    id BIGINT GENERATED ALWAYS AS IDENTITY PRIMARY KEY, fleet TEXT NOT NULL, action TEXT NOT NULL, device TEXT NOT NULL,
    code TEXT NOT NULL, at_ms BIGINT NOT NULL, until_ms BIGINT, reason TEXT NOT NULL DEFAULT '', by TEXT NOT NULL,
    origin TEXT NOT NULL UNIQUE
);
CREATE INDEX alarm_actions_of_fleet ON alarm_actions(fleet, id);
""",
)


class DatabaseLost(MeshctlError):
    """The database does not answer, since its server or the network is down, or it takes nothing for now."""


# SQLSTATE: a read-only server, no room or memory, a statement that took too long, an error of the disk
_UNUSABLE = ("25006", "53", "57", "58")
UNUSABLE_HINT = "with MESHCTL_STORE= (empty), meshctl uses the journal of this computer"


def check_url(url: str) -> None:
    """Raises InputError for anything but the URL of a PostgreSQL database."""
    if not url.startswith(_SCHEMES):
        shown = re.sub(r"://[^@/]*@", "://", url)
        raise InputError(
            f"MESHCTL_STORE: expected postgresql://USER@HOST/DATABASE, found {shown!r}",
            hint="unset it to keep the journal in a file of this computer",
        )
    try:
        from psycopg.conninfo import conninfo_to_dict
    except ImportError as error:
        raise InputError(
            f"MESHCTL_STORE needs psycopg 3: {error}", hint="pip install 'meshctl-fleet[postgresql]'"
        ) from error
    import psycopg

    try:
        if not all(port.isdecimal() for port in str(conninfo_to_dict(url).get("port") or 0).split(",")):
            raise psycopg.ProgrammingError
    except psycopg.Error as error:
        # libpq quotes the URL with its password
        raise InputError(
            "MESHCTL_STORE: the URL of the database is malformed",
            hint="expected postgresql://USER@HOST:PORT/DATABASE; special characters as %XX",
        ) from error


def label_of(url: str) -> str:
    """The database without user and password: names it in messages and in what is kept for it."""
    from psycopg.conninfo import conninfo_to_dict

    parts = conninfo_to_dict(url)
    host, port, name = parts.get("host") or "", parts.get("port") or "", parts.get("dbname") or parts.get("user") or ""
    return f"postgresql://{host}{f':{port}' if port else ''}/{name}"


class Database:
    """An open connection, with the journal's tables up to date. Safe for several threads."""

    def __init__(self, url: str, *, program: str = "meshctl") -> None:
        """Connect. Raises InputError for a bad URL, DatabaseLost, and MeshctlError for tables of a newer version."""
        check_url(url)
        self.label = label_of(url)
        self._url, self._program = url, program
        self._lock = threading.RLock()
        self._connection = self._connect()
        self._node_locks: list[int] = []
        self._run_locks: set[int] = set()
        self._listener: psycopg.Connection[Any] | None = None
        try:
            self._migrate()
        except BaseException:
            self._connection.close()
            raise

    def _connect(self) -> psycopg.Connection[Any]:
        import psycopg

        try:
            return psycopg.connect(
                self._url,
                autocommit=True,
                connect_timeout=CONNECT_TIMEOUT_S,
                tcp_user_timeout=SILENCE_TIMEOUT_MS,
                keepalives_idle=2,
                keepalives_interval=1,
                keepalives_count=3,
                application_name=self._program,
                options=f"-c search_path=meshctl -c statement_timeout={STATEMENT_TIMEOUT_MS}",
                # the values stand in the text, so that a NULL needs no type
                cursor_factory=psycopg.ClientCursor,
            )
        except psycopg.OperationalError as error:
            raise DatabaseLost(
                f"{self.label}: cannot connect: {_one_line(error)}", hint="check the network and MESHCTL_STORE"
            ) from error

    def _migrate(self) -> None:
        expected = len(MIGRATIONS)
        with self.transaction() as transaction:
            ((exists,),) = transaction.execute("SELECT to_regclass('meshctl.version') IS NOT NULL").fetchall()
            ((version,),) = transaction.execute("SELECT version FROM version").fetchall() if exists else ((0,),)
        if version == expected:
            return
        with self.transaction() as transaction:
            # two operators may be the first ones
            transaction.execute("SELECT pg_advisory_xact_lock(?, 0)", (_RUN_LOCKS,))
            transaction.execute("CREATE SCHEMA IF NOT EXISTS meshctl")
            transaction.execute("CREATE TABLE IF NOT EXISTS version (version INTEGER NOT NULL)")
            found = transaction.execute("SELECT version FROM version").fetchone()
            version = 0 if found is None else found[0]
            if version > expected:
                raise MeshctlError(
                    f"{self.label}: its tables have version {version}, expected {expected}",
                    hint="a newer meshctl has upgraded them: upgrade this one, too",
                )
            for statements in MIGRATIONS[version:]:
                transaction.execute(statements)
            transaction.execute("DELETE FROM version")
            transaction.execute("INSERT INTO version VALUES (?)", (expected,))

    @contextmanager
    def transaction(self) -> Iterator[_Transaction]:
        """One transaction; sessions that listen are notified. Raises DatabaseLost, MeshctlError."""
        with self._lock, self._errors("write"), self._connection.transaction():
            transaction = _Transaction(self._connection)
            yield transaction
            if transaction.has_written:
                transaction.execute(f"NOTIFY {CHANNEL}")

    def read(self, query: str, values: tuple[object, ...]) -> list[tuple[Any, ...]]:
        """The rows of a query. Raises DatabaseLost, MeshctlError."""
        with self._lock, self._errors("read"):
            return [tuple(row) for row in _Transaction(self._connection).execute(query, values).fetchall()]

    @contextmanager
    def _errors(self, verb: str) -> Iterator[None]:
        import psycopg

        try:
            with deadline(ANSWER_TIMEOUT_S, partial(_hang_up, self._connection)):
                yield
        except psycopg.Error as error:
            if self._connection.broken or self._connection.closed or isinstance(error, psycopg.errors.AdminShutdown):
                raise DatabaseLost(f"{self.label}: the connection was lost: {_one_line(error)}") from error
            if (error.sqlstate or "").startswith(_UNUSABLE):
                raise DatabaseLost(
                    f"{self.label}: cannot {verb} the journal: {_one_line(error)}", hint=UNUSABLE_HINT
                ) from error
            raise MeshctlError(f"{self.label}: cannot {verb} the journal: {_one_line(error)}") from error

    def lock_run(self, run: int) -> None:
        """Show that the process of a run lives, until the connection ends."""
        self.read("SELECT pg_try_advisory_lock(?, ?)", (_RUN_LOCKS, run % 2**31))
        self._run_locks.add(run)

    def connected_runs(self) -> frozenset[int]:
        """The runs (modulo 2^31) whose process is connected."""
        rows = self.read(
            "SELECT objid FROM pg_locks WHERE locktype = 'advisory' AND classid = ? AND objsubid = 2 AND granted"
            " AND database = (SELECT oid FROM pg_database WHERE datname = current_database())",
            (_RUN_LOCKS,),
        )
        return frozenset(int(row[0]) for row in rows)

    def lock_nodes(self, fleet: str, nodes: Sequence[str]) -> tuple[str, ...]:
        """Lock nodes until the connection ends; returns those that another session has locked, and locks none then."""
        got: list[str] = []
        taken: list[str] = []
        for node in sorted(set(nodes)):
            ((locked,),) = self.read("SELECT pg_try_advisory_lock(?)", (_node_key(fleet, node),))
            (got if locked else taken).append(node)
        if taken:
            for node in got:
                self.read("SELECT pg_advisory_unlock(?)", (_node_key(fleet, node),))
        else:
            self._node_locks += [_node_key(fleet, node) for node in got]
        return tuple(taken)

    def reconnect(self) -> None:
        """Connect again, and take the locks again that no other session took meanwhile. Raises DatabaseLost."""
        connection = self._connect()
        with self._lock:
            self._connection.close()
            self._connection = connection
        for key in self._node_locks:
            self.read("SELECT pg_try_advisory_lock(?)", (key,))
        for run in self._run_locks:
            self.lock_run(run)

    def wait_for_change(self, timeout_s: float) -> bool:
        """Wait for a transaction of any operator; from the first call on, none is missed. Raises DatabaseLost."""
        import psycopg

        try:
            if self._listener is None:
                self._listener = self._connect()
                self._listener.execute(f"LISTEN {CHANNEL}")
                # rows that were written before the first call sent no notification
                return True
            return any(True for _ in self._listener.notifies(timeout=timeout_s, stop_after=1))
        except psycopg.Error as error:
            self._listener = None
            raise DatabaseLost(f"{self.label}: the connection was lost: {_one_line(error)}") from error

    def close(self) -> None:
        with self._lock:
            for connection in (self._listener, self._connection):
                if connection is not None:
                    with suppress(Exception):
                        connection.close()


def _hang_up(connection: psycopg.Connection[Any]) -> None:
    """End a connection whose server does not answer, from another thread: who waits for it gets an error."""
    with suppress(Exception), socket.socket(fileno=os.dup(connection.fileno())) as end:
        end.shutdown(socket.SHUT_RDWR)


class _Transaction:
    """Executes statements with SQLite's placeholders."""

    def __init__(self, connection: psycopg.Connection[Any]) -> None:
        self._connection = connection
        self.has_written = False

    def execute(self, statement: str, values: Sequence[object] = (), /) -> psycopg.Cursor[Any]:
        self.has_written = self.has_written or not statement.startswith("SELECT")
        text, numbered = _translated(statement)
        named = {f"p{number}": value for number, value in enumerate(values, 1)}
        if not values:
            return self._connection.execute(statement.encode())
        return self._connection.execute(text.encode(), named if numbered else tuple(values))

    def executemany(self, statement: str, values: Sequence[Sequence[object]], /) -> None:
        for each in values:
            self.execute(statement, each)


@lru_cache(maxsize=256)
def _translated(statement: str) -> tuple[str, bool]:
    """The statement with psycopg's placeholders, and whether they are numbered."""
    text = statement.replace("%", "%%")
    numbered, count = re.subn(r"\?(\d+)", r"%(p\1)s", text)
    return (numbered, True) if count else (text.replace("?", "%s"), False)


def _node_key(fleet: str, node: str) -> int:
    """The 64-bit key of a node's advisory lock."""
    digest = hashlib.sha256(f"{fleet}\x1f{node}".encode()).digest()
    return int.from_bytes(digest[:8], "big", signed=True)


def _one_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
