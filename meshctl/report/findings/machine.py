"""Findings for scripts: one JSON document, with stable keys and a version."""

from __future__ import annotations

import json as encoder
from typing import Any

from meshctl.diagnostics import Diagnostic, Severity
from meshctl.lint.baseline import fingerprint
from meshctl.report.findings.document import Findings

# raised when a key changes its meaning or goes away
_VERSION = 1


def json(findings: Findings) -> str:
    """`{"version", "findings": [...], "summary": {...}}`, indented, ending with a line end."""
    count = findings.count()
    document = {
        "version": _VERSION,
        "findings": [_finding(item) for item in findings.diagnostics],
        "suppressed": [{**_finding(item.diagnostic), "reason": item.reason} for item in findings.excused],
        "summary": {
            **{severity.value: count[severity] for severity in Severity},
            "suppressed": len(findings.excused),
            "baseline": len(findings.known),
            "files": list(findings.files),
        },
    }
    return encoder.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _finding(item: Diagnostic) -> dict[str, Any]:
    return {
        "code": item.code,
        "severity": item.severity.value,
        "file": item.position.file,
        "line": item.position.line,
        "column": item.position.column,
        "path": item.path,
        "message": item.message,
        "expected": item.expected,
        "found": item.found,
        "hint": item.hint,
        "fingerprint": fingerprint(item),
    }
