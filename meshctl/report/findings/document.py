"""What a report of findings is made of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

from meshctl.diagnostics import Diagnostic, Position, Severity
from meshctl.lint import Suppressed

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

    def lines(self) -> dict[str, list[str]]:
        """The lines of the files in which something was found."""
        wanted = {item.position.file for item in self.diagnostics}
        # as editors and PyYAML count them, not str.splitlines, which also ends lines at form feeds
        return {file: text.split("\n") for file, text in self.sources.items() if file in wanted}

    def count(self) -> Counter[Severity]:
        """How many findings there are of each severity."""
        return Counter(item.severity for item in self.diagnostics)


def shown_line(lines: dict[str, list[str]], position: Position) -> str | None:
    """The line of a place, None when its text is not known or it is too long to show."""
    known = lines.get(position.file)
    if known is None or not 1 <= position.line <= len(known):
        return None
    line = known[position.line - 1].rstrip()
    return line if len(line) <= _LONGEST_LINE else None


def counted(number: int, noun: str) -> str:
    """`1 error`, `2 errors`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def printable(text: str) -> str:
    """Text whose control characters, which could move a terminal's cursor, are shown as `?`."""
    return "".join(letter if letter.isprintable() or letter == "\t" else "?" for letter in text)
