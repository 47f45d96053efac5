"""Findings for people and for other tools: text, JSON, SARIF 2.1.0, JUnit XML, GitHub annotations.

Each format is a function of that name, from `Findings` to text, in a module of its own.
"""

from importlib import import_module

from meshctl.report.findings.document import Findings
from meshctl.report.findings.plain import summary

# As the command line names them -> the module, which is imported only for its format.
FORMATS = {"text": "plain", "json": "machine", "sarif": "sarif", "junit": "junit", "github": "annotations"}


def formatted(findings: Findings, name: str, width: int | None = None) -> str:
    """The findings in one of `FORMATS`; `text` is wrapped at `width`."""
    write = getattr(import_module(f"meshctl.report.findings.{FORMATS[name]}"), name)
    text: str = write(findings, width) if name == "text" else write(findings)
    return text


__all__ = ["FORMATS", "Findings", "formatted", "summary"]
