"""Diagnostics of an input: severity, stable code, position, message and hint.

Parsers collect all diagnostics instead of stopping at the first; reports turn them into text, JSON, SARIF, JUnit XML or
GitHub annotations.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from meshctl.errors import InputError


class Severity(Enum):
    """ERROR would break or endanger a node, WARNING may, NOTE informs."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"

    @property
    def rank(self) -> int:
        """0 for the most severe, so that sorting puts errors first."""
        return ("error", "warning", "note").index(self.value)


@dataclass(frozen=True, slots=True, order=True)
class Position:
    """A position in a text file; `line` and `column` count from 1, 0 means unknown."""

    file: str
    line: int = 0
    column: int = 0

    def __str__(self) -> str:
        if not self.line:
            return self.file
        return f"{self.file}:{self.line}:{self.column}" if self.column else f"{self.file}:{self.line}"


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """One finding. `path` is the dotted path in the inventory (`nodes.b03.radios.radio0.channel`), or empty."""

    code: str
    severity: Severity
    position: Position
    message: str
    path: str = ""
    expected: str = ""
    found: str = ""
    hint: str = ""

    @property
    def text(self) -> str:
        """The message with what was expected and found, without the position."""
        sides = [
            part
            for part in (self.expected and f"expected {self.expected}", self.found and f"found {self.found}")
            if part
        ]
        body = (
            self.message if not sides else f"{self.message}: {', '.join(sides)}" if self.message else ", ".join(sides)
        )
        return f"{self.path}: {body}" if self.path else body

    def __str__(self) -> str:
        """`inventory/fleet.yaml:14:7: radios.b03.channel: expected one of 1-11, found 13 [MC012]`."""
        return f"{self.position}: {self.text} [{self.code}]"


class InvalidInput(InputError):
    """An input with at least one error; has all diagnostics, not only the first."""

    def __init__(self, diagnostics: Iterable[Diagnostic]) -> None:
        self.diagnostics = sorted_diagnostics(diagnostics)
        super().__init__("\n".join(f"{item}\n  = {item.hint}" if item.hint else str(item) for item in self.diagnostics))


def sorted_diagnostics(diagnostics: Iterable[Diagnostic]) -> tuple[Diagnostic, ...]:
    """Sorted by position, severity and code, so that reports are deterministic."""
    return tuple(sorted(diagnostics, key=lambda d: (d.position, d.severity.rank, d.code, d.path, d.message, d.found)))


def worst(diagnostics: Iterable[Diagnostic]) -> Severity | None:
    """The highest severity, or None without diagnostics."""
    return min((item.severity for item in diagnostics), key=lambda severity: severity.rank, default=None)
