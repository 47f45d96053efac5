"""Findings for people: place, severity, message, code; the line with a caret; how to fix it; a summary."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.inventory.redaction import Excerpts
from meshctl.report.findings.document import Findings, printable, shown_line
from meshctl.report.line_wrap import wrap
from meshctl.wording import counted


def text(findings: Findings, width: int | None = None) -> str:
    """Plain text without colors, one block for each finding; ends with a line end. Sentences are wrapped at `width`,
    the inventory's lines are not."""
    lines = findings.excerpts()
    blocks = ["\n".join(_block(item, lines, width)) for item in findings.diagnostics]
    return "\n".join([*blocks, summary(findings)]) + "\n"


def _block(item: Diagnostic, lines: Mapping[str, Excerpts], width: int | None) -> Iterator[str]:
    yield from wrap(f"{item.position}: {item.severity.value}: {printable(item.text)} [{item.code}]", width)
    found = shown_line(lines, item.position)
    if found is not None and found[0]:
        line, column = found
        number = str(item.position.line)
        yield f"  {number} | {printable(line)}"
        if column:
            # a tab before the column keeps its width under the caret
            before = "".join("\t" if letter == "\t" else " " for letter in line[: column - 1])
            yield f"  {' ' * len(number)} | {before}^"
    if item.hint:
        yield from wrap(f"  = {printable(item.hint)}", width)


def summary(findings: Findings) -> str:
    """`2 warnings in 1 file (1 suppressed)`."""
    count = findings.count()
    kinds = [counted(count[severity], severity.value) for severity in Severity if count[severity]]
    aside = []
    if findings.excused:
        aside.append(f"{len(findings.excused)} suppressed")
    if findings.known:
        aside.append(f"{len(findings.known)} in the baseline")
    looked_at = counted(len(findings.files), "file")
    return f"{', '.join(kinds) or 'nothing found'} in {looked_at}" + (f" ({', '.join(aside)})" if aside else "")
