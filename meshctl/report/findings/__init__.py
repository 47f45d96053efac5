"""Findings for people and for other tools: text, JSON, SARIF 2.1.0, JUnit XML, GitHub annotations.

Each format is a function from `Findings` to text; `FORMATS` names them as the command line does.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from meshctl.report.findings.annotations import github
from meshctl.report.findings.document import Findings
from meshctl.report.findings.junit import junit
from meshctl.report.findings.machine import json
from meshctl.report.findings.plain import text
from meshctl.report.findings.sarif import sarif

FORMATS: Mapping[str, Callable[[Findings], str]] = MappingProxyType(
    {"text": text, "json": json, "sarif": sarif, "junit": junit, "github": github}
)

__all__ = ["FORMATS", "Findings", "github", "json", "junit", "sarif", "text"]
