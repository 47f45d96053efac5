"""Computers of operators who share a journal."""

from __future__ import annotations

from pathlib import Path

from meshctl.fleet.journal import Journal
from meshctl.fleet.journal_store import open_journal


class Laptop:
    """An operator's computer: a state directory, and the way to the database."""

    def __init__(self, state: Path, url: str) -> None:
        self.environ = {"XDG_STATE_HOME": str(state), "MESHCTL_STORE": url}
        self.notices: list[str] = []

    def open(self) -> Journal:
        return open_journal(self.environ, self.notices.append)
