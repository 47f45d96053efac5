"""Comments that suppress a finding: `# meshctl: ignore MC424 -- why`.

Text -> suppressions (`find`) -> findings split into reported and suppressed ones (`apply`), plus findings about the
comments themselves. A comment on its own line applies to the next line with content.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import yaml

from meshctl.diagnostics import Diagnostic, Position, sorted_diagnostics
from meshctl.inventory.compose import yaml_events
from meshctl.lint.engine import diagnostic
from meshctl.lint.rule import CODE, Finding
from meshctl.lint.rules.housekeeping import NO_REASON, UNKNOWN_CODE, UNUSED

_COMMENT = re.compile(r"#\s*meshctl:\s*ignore\b(?P<codes>.*?)(?:\s--(?P<reason>.*))?$", re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Suppression:
    """One comment: its position, the line it applies to, and the codes and reason as written."""

    position: Position
    line: int
    codes: tuple[str, ...]
    reason: str


@dataclass(frozen=True, slots=True)
class Suppressed:
    """A finding suppressed by a comment."""

    diagnostic: Diagnostic
    reason: str


@dataclass(frozen=True, slots=True)
class SplitFindings:
    """The reported findings, including those about comments, and the suppressed ones."""

    reported: tuple[Diagnostic, ...]
    suppressed: tuple[Suppressed, ...]


def find(file: str, text: str) -> tuple[Suppression, ...]:
    """The suppressions in a file, in order; text in quotes or block scalars does not count."""
    matches = list(_COMMENT.finditer(text))
    if not matches:
        return ()
    inside = _inside_scalars(text, [match.start() for match in matches])
    lines = text.split("\n")
    found = []
    for match in matches:
        if match.start() in inside:
            continue
        row = text.count("\n", 0, match.start())
        column = match.start() - (text.rfind("\n", 0, match.start()) + 1)
        applies_to = row
        if not lines[row][:column].strip():
            applies_to = next((n for n in range(row + 1, len(lines)) if _has_content(lines[n])), row)
        codes = tuple(re.split(r"[\s,]+", match["codes"].strip())) if match["codes"].strip() else ()
        position = Position(file, row + 1, column + 1)
        found.append(Suppression(position, applies_to + 1, codes, (match["reason"] or "").strip()))
    return tuple(found)


def _has_content(line: str) -> bool:
    stripped = line.strip()
    return bool(stripped) and not stripped.startswith("#")


def _inside_scalars(text: str, offsets: list[int]) -> set[int]:
    """The offsets inside a scalar. Invalid YAML has scalars up to the error."""
    spans = []
    try:
        for event in yaml_events(text):
            if isinstance(event, yaml.ScalarEvent) and event.start_mark is not None and event.end_mark is not None:
                spans.append((event.start_mark.index, event.end_mark.index))
    except yaml.YAMLError:
        pass
    inside = set()
    position = 0
    for offset in offsets:
        while position < len(spans) and spans[position][1] <= offset:
            position += 1
        if position < len(spans) and spans[position][0] <= offset:
            inside.add(offset)
    return inside


def apply(
    diagnostics: Iterable[Diagnostic],
    sources: Mapping[str, str],
    known: Collection[str],
    ran: Collection[str],
) -> SplitFindings:
    """Split findings by the comments in `sources`.

    `known` are all rules' codes, `ran` those that were looked for: a comment is useless only for a code
    that ran.
    """
    comments = [item for file, text in sources.items() for item in find(file, text)]
    excuses: dict[tuple[str, int, str], Suppression] = {}
    for comment in comments:
        if comment.reason:
            for code in comment.codes:
                excuses.setdefault((comment.position.file, comment.line, code), comment)
    stay: list[Diagnostic] = []
    excused: list[Suppressed] = []
    used: set[tuple[Position, str]] = set()
    for item in diagnostics:
        excuse = excuses.get((item.position.file, item.position.line, item.code)) if CODE.fullmatch(item.code) else None
        if excuse is None:
            stay.append(item)
        else:
            used.add((excuse.position, item.code))
            excused.append(Suppressed(item, excuse.reason))
    for comment in comments:
        stay.extend(_comment_findings(comment, known, ran, used))
    return SplitFindings(sorted_diagnostics(stay), tuple(excused))


def _comment_findings(
    comment: Suppression, known: Collection[str], ran: Collection[str], used: Collection[tuple[Position, str]]
) -> Iterable[Diagnostic]:
    unknown = [code for code in comment.codes if code not in known]
    if not comment.codes:
        yield diagnostic(UNKNOWN_CODE, Finding((), "", "a code such as MC424", "none"), comment.position)
    for code in unknown:
        yield diagnostic(UNKNOWN_CODE, Finding((), "", "the code of a rule", code), comment.position)
    if not comment.reason:
        yield diagnostic(NO_REASON, Finding((), "", "a reason after --", "none"), comment.position)
        return
    for code in comment.codes:
        if code in ran and (comment.position, code) not in used:
            finding = Finding((), f"no such finding on line {comment.line}", "", code)
            yield diagnostic(UNUSED, finding, comment.position)
