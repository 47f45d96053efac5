"""The parts of a report of findings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.inventory.redaction import Excerpts
from meshctl.lint import Suppressed
from meshctl.report.terminal_escapes import one_line

# more of a line tells a reader nothing, and a minified file must not fill the screen
_LONGEST_LINE = 160


@dataclass(frozen=True, slots=True)
class Findings:
    """`diagnostics` are reported; `excused` by comments and `known` from the baseline are counted (SARIF lists them).

    `sources` maps files to their text, `files` are all that were looked at.
    """

    diagnostics: tuple[Diagnostic, ...]
    sources: Mapping[str, str] = field(default_factory=dict)
    excused: tuple[Suppressed, ...] = ()
    known: tuple[Diagnostic, ...] = ()
    files: tuple[str, ...] = ()

    def excerpts(self) -> dict[str, Excerpts]:
        """The files in which something was found, as they may be shown."""
        wanted = {item.position.file for item in self.diagnostics}
        return {file: Excerpts(text) for file, text in self.sources.items() if file in wanted}

    def count(self) -> Counter[Severity]:
        """How many findings there are of each severity."""
        return Counter(item.severity for item in self.diagnostics)


def shown_line(excerpts: Mapping[str, Excerpts], position: Position) -> tuple[str, int] | None:
    """The line of a place without secrets, and the column in it; None when it is not known or too long to show."""
    known = excerpts.get(position.file)
    found = None if known is None else known.line(position.line, position.column)
    return None if found is None or len(found[0]) > _LONGEST_LINE else found


def printable(text: str) -> str:
    """Text within a line, with a stand-in for each character that could move a terminal's cursor."""
    return one_line(text)
