"""Lint rules over the whole inventory, each a small function with a stable code, a page and two examples.

Flow: `rules/` -> `catalog` (all rules) -> `engine` (fleet -> findings) -> `suppress`, `baseline` (known findings)
-> `check_path` (path -> result). `context` and `files` give rules access to secrets and files. `example` and `pages`
generate docs/lint/.
"""

from meshctl.lint.catalog import BY_CODE, RULES
from meshctl.lint.check_path import CheckResult, check_path
from meshctl.lint.context import Files, LintContext, no_secret
from meshctl.lint.engine import lint
from meshctl.lint.files import DiskFiles
from meshctl.lint.rule import Example, Finding, Rule
from meshctl.lint.suppress import Suppressed

__all__ = [
    "BY_CODE",
    "RULES",
    "CheckResult",
    "DiskFiles",
    "Example",
    "Files",
    "Finding",
    "LintContext",
    "Rule",
    "Suppressed",
    "check_path",
    "lint",
    "no_secret",
]
