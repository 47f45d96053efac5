"""Findings as SARIF 2.1.0 (OASIS, sarif-schema-2.1.0): one run, its rules, results with places and fingerprints.

Paths become URI references relative to the working directory, which is what code-scanning services expect of a run at
the top of a repository. Suppressed findings are listed with their reason, those of the baseline as unchanged.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from urllib.parse import quote

from meshctl import __version__
from meshctl.diagnostics import Diagnostic, Severity
from meshctl.inventory.codes import MEANINGS
from meshctl.lint import BY_CODE
from meshctl.lint.baseline import fingerprint
from meshctl.report.findings.document import Findings

_SCHEMA = "https://docs.oasis-open.org/sarif/sarif/v2.1.0/errata01/os/schemas/sarif-schema-2.1.0.json"
_LEVELS = {Severity.ERROR: "error", Severity.WARNING: "warning", Severity.NOTE: "note"}


def sarif(findings: Findings) -> str:
    """A SARIF log as JSON, ending with a line end."""
    everything = [*findings.diagnostics, *(item.diagnostic for item in findings.excused), *findings.known]
    codes = sorted({item.code for item in everything})
    index = {code: number for number, code in enumerate(codes)}
    # section 3.27.24: a state on one result asks for a state on all
    state = {"baselineState": "new"} if findings.known else {}
    results = [{**_result(item, index), **state} for item in findings.diagnostics]
    results += [
        {
            **_result(item.diagnostic, index),
            **state,
            "suppressions": [{"kind": "inSource", "status": "accepted", "justification": item.reason}],
        }
        for item in findings.excused
    ]
    results += [
        {**_result(item, index), "baselineState": "unchanged", "suppressions": [{"kind": "external"}]}
        for item in findings.known
    ]
    driver = {
        "name": "meshctl",
        "version": __version__,
        "semanticVersion": __version__,
        "rules": [_rule(code) for code in codes],
    }
    run = {
        "tool": {"driver": driver},
        "columnKind": "unicodeCodePoints",
        "originalUriBaseIds": {"%SRCROOT%": {"description": {"text": "The directory meshctl was run in."}}},
        "artifacts": [{"location": _location(file)} for file in findings.files],
        "results": results,
    }
    return json.dumps({"$schema": _SCHEMA, "version": "2.1.0", "runs": [run]}, indent=2, ensure_ascii=False) + "\n"


def _rule(code: str) -> dict[str, Any]:
    rule = BY_CODE.get(code)
    if rule is None:
        meaning = MEANINGS.get(code, code)
        return {"id": code, "shortDescription": {"text": meaning}, "defaultConfiguration": {"level": "error"}}
    return {
        "id": code,
        "name": "".join(word.capitalize() for word in rule.name.split("-")),
        "shortDescription": {"text": f"{rule.title}."},
        "fullDescription": {"text": rule.why},
        "help": {"text": f"{rule.why} {rule.fix}", "markdown": f"{rule.why}\n\n{rule.fix}"},
        "defaultConfiguration": {"level": _LEVELS[rule.severity]},
    }


def _result(item: Diagnostic, index: dict[str, int]) -> dict[str, Any]:
    message = f"{item.text}. {item.hint}" if item.hint else item.text
    physical: dict[str, Any] = {"artifactLocation": _location(item.position.file)}
    if item.position.line:
        region = {"startLine": item.position.line}
        if item.position.column:
            region["startColumn"] = item.position.column
        physical["region"] = region
    location: dict[str, Any] = {"physicalLocation": physical}
    if item.path:
        location["logicalLocations"] = [{"fullyQualifiedName": item.path}]
    return {
        "ruleId": item.code,
        "ruleIndex": index[item.code],
        "level": _LEVELS[item.severity],
        "message": {"text": message},
        "locations": [location],
        "partialFingerprints": {"meshctl/v1": fingerprint(item)},
    }


def _location(file: str) -> dict[str, str]:
    path = Path(file)
    if path.is_absolute():
        try:
            path = path.relative_to(Path.cwd())
        except ValueError:
            return {"uri": path.as_uri()}
    return {"uri": quote(path.as_posix()), "uriBaseId": "%SRCROOT%"}
