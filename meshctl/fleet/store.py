"""The interface between the journal and its database: rows out, transactions in.

`SqliteFile` (one laptop, the default) and `SharedStore` (PostgreSQL, several operators) are such stores. Statements are
written once, for both: placeholders `?` or `?1`, and only SQL that SQLite and PostgreSQL understand alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

Statement = tuple[str, tuple[object, ...]]
"""An SQL statement and its values."""


class Rows(Protocol):
    """The answer to a statement."""

    def fetchone(self) -> Any: ...

    def fetchall(self) -> list[Any]: ...


class Transaction(Protocol):
    """An open transaction."""

    def execute(self, statement: str, values: Sequence[object] = (), /) -> Rows: ...

    def executemany(self, statement: str, values: Sequence[Sequence[object]], /) -> object: ...


@dataclass(frozen=True, slots=True)
class Claim:
    """A node that another run is changing; `owner` is `user@host`."""

    node: str
    owner: str
    run: int


class Store(Protocol):
    """A database. Safe for several threads and processes."""

    @property
    def path(self) -> Path:
        """The file; a shared store: where this computer keeps the files of its runs."""

    @property
    def is_shared(self) -> bool:
        """Whether other computers write there, too."""

    @property
    def notice(self) -> str:
        """A note for the operator about the entries of this process; empty if all are in the database."""

    def read(self, query: str, values: tuple[object, ...] = ()) -> list[tuple[Any, ...]]:
        """The rows of a query. Raises MeshctlError."""

    def write(self, wait_s: float) -> AbstractContextManager[Transaction]:
        """One transaction, rolled back if the block raises. Raises MeshctlError if it cannot be written, or is locked
        for longer than `wait_s`."""

    def put(self, statements: Sequence[Statement], wait_s: float) -> None:
        """Execute statements in one transaction. A shared store keeps them here while its database is out of reach.
        Raises MeshctlError."""

    def claim(self, fleet: str, nodes: Sequence[str], run: int) -> tuple[Claim, ...]:
        """Claim nodes for a run until the store is closed or the process ends; returns those that another run has, and
        claims none then. Only a shared store has claims: on one computer the lock on the node is enough."""

    def connected_runs(self) -> frozenset[int] | None:
        """The runs whose process is connected to the store; None where only this computer writes."""

    def wait_for_change(self, timeout_s: float) -> bool:
        """Wait until another process has written, or the time is over; whether something may have changed."""

    def close(self) -> None: ...
