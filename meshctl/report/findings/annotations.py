"""Findings as GitHub's workflow commands: `::error file=...,line=...,col=...,title=...::message`.

Percent, line ends, and in properties also colon and comma are escaped, as the runner's own toolkit does; so no text
from an inventory can start a command of its own.
"""

from __future__ import annotations

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.report.findings.document import Findings

_COMMANDS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.NOTE: "notice"}


def github(findings: Findings) -> str:
    """One line for each finding; empty when there is none."""
    return "".join(f"{_command(item)}\n" for item in findings.diagnostics)


def _command(item: Diagnostic) -> str:
    properties = {"file": item.position.file}
    if item.position.line:
        properties["line"] = str(item.position.line)
    if item.position.column:
        properties["col"] = str(item.position.column)
    properties["title"] = f"meshctl {item.code}"
    listed = ",".join(f"{name}={_property(value)}" for name, value in properties.items())
    message = f"{item.text}\n{item.hint}" if item.hint else item.text
    return f"::{_COMMANDS[item.severity]} {listed}::{_data(message)}"


def _data(text: str) -> str:
    return text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")


def _property(text: str) -> str:
    return _data(text).replace(":", "%3A").replace(",", "%2C")
