"""Findings as JUnit XML, in the form that GitLab, Jenkins and others read: a suite for each file, a case for each
finding; a file without findings is one case that passed."""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.etree import ElementTree

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.report.findings.document import Findings

# what XML 1.0 section 2.2 does not allow in a document at all
_FORBIDDEN = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def junit(findings: Findings) -> str:
    """An XML document, ending with a line end. Errors and warnings are failures, notes are not."""
    root = ElementTree.Element("testsuites", name="meshctl lint")
    by_file: dict[str, list[Diagnostic]] = {file: [] for file in findings.files}
    for item in findings.diagnostics:
        by_file.setdefault(item.position.file, []).append(item)
    failures = 0
    for file, items in by_file.items():
        suite = _suite(file, items)
        failures += _failing(items)
        root.append(suite)
    root.set("tests", str(sum(max(len(items), 1) for items in by_file.values())))
    root.set("failures", str(failures))
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0" encoding="utf-8"?>\n{body}\n'


def _suite(file: str, items: list[Diagnostic]) -> ElementTree.Element:
    suite = ElementTree.Element(
        "testsuite", name=_clean(file), tests=str(max(len(items), 1)), failures=str(_failing(items)), errors="0"
    )
    if not items:
        ElementTree.SubElement(suite, "testcase", classname=_clean(file), name="lint")
    for item in items:
        suite.append(_case(file, item))
    return suite


def _case(file: str, item: Diagnostic) -> ElementTree.Element:
    name = f"{item.code} {item.path or item.position}"
    case = ElementTree.Element("testcase", classname=_clean(file), name=_clean(name))
    if item.position.line:
        case.set("file", _clean(file))
        case.set("line", str(item.position.line))
    words = _clean(f"{item.position}: {item.text} [{item.code}]" + (f"\n{item.hint}" if item.hint else ""))
    if item.severity is Severity.NOTE:
        ElementTree.SubElement(case, "system-out").text = words
    else:
        failure = ElementTree.SubElement(case, "failure", type=item.severity.value, message=_clean(item.text))
        failure.text = words
    return case


def _failing(items: Iterable[Diagnostic]) -> int:
    return sum(1 for item in items if item.severity is not Severity.NOTE)


def _clean(text: str) -> str:
    return _FORBIDDEN.sub("?", text)
