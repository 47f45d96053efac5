"""Findings as JUnit XML, in the form that GitLab, Jenkins and others read: a suite for each file, a case for each
finding; a file without findings is one case that passed.

The document is valid by the strict schema (JUnit.xsd of Apache Ant's reports), which allows neither totals at the root
nor text in a case that passed: a note's words are in its suite's output.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from datetime import UTC, datetime
from xml.etree import ElementTree

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.report.findings.document import Findings

# characters that XML 1.0 section 2.2 does not allow in a document
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit(findings: Findings, moment: datetime | None = None) -> str:
    """An XML document, ending with a line end. Errors and warnings are failures, notes are not.

    `moment` is when lint ran; without it $SOURCE_DATE_EPOCH (seconds, for reports that can be reproduced), or now.
    """
    stamp = (moment or _now()).strftime("%Y-%m-%dT%H:%M:%S")
    root = ElementTree.Element("testsuites")
    by_file: dict[str, list[Diagnostic]] = {file: [] for file in findings.files}
    for item in findings.diagnostics:
        by_file.setdefault(item.position.file, []).append(item)
    for number, (file, items) in enumerate(by_file.items()):
        suite = _suite(file, items, stamp)
        suite.set("id", str(number))
        root.append(suite)
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{body}\n'


def _now() -> datetime:
    try:
        return datetime.fromtimestamp(int(os.environ["SOURCE_DATE_EPOCH"]), UTC)
    except (KeyError, ValueError, OverflowError, OSError):
        # not set, or no time that a timestamp can have
        return datetime.now(UTC)


def _suite(file: str, items: list[Diagnostic], stamp: str) -> ElementTree.Element:
    suite = ElementTree.Element(
        "testsuite",
        name=_clean(file) or "inventory",
        package="meshctl.lint",
        timestamp=stamp,
        hostname="localhost",
        tests=str(max(len(items), 1)),
        failures=str(_failing(items)),
        errors="0",
        time="0",
    )
    ElementTree.SubElement(suite, "properties")
    if not items:
        ElementTree.SubElement(suite, "testcase", classname=_clean(file), name="lint", time="0")
    for item in items:
        suite.append(_case(file, item))
    notes = [_words(item) for item in items if item.severity is Severity.NOTE]
    ElementTree.SubElement(suite, "system-out").text = "\n".join(notes)
    ElementTree.SubElement(suite, "system-err")
    return suite


def _case(file: str, item: Diagnostic) -> ElementTree.Element:
    # the place tells two findings of one kind apart, and is what CI shows first
    name = f"{item.code} {item.path} at {item.position}" if item.path else f"{item.code} at {item.position}"
    case = ElementTree.Element("testcase", classname=_clean(file), name=_clean(name), time="0")
    if item.severity is not Severity.NOTE:
        failure = ElementTree.SubElement(case, "failure", type=item.severity.value, message=_clean(item.text))
        failure.text = _words(item)
    return case


def _words(item: Diagnostic) -> str:
    return _clean(f"{item.position}: {item.text} [{item.code}]" + (f"\n{item.hint}" if item.hint else ""))


def _failing(items: Iterable[Diagnostic]) -> int:
    return sum(1 for item in items if item.severity is not Severity.NOTE)


def _clean(text: str) -> str:
    return _FORBIDDEN.sub("?", text)
