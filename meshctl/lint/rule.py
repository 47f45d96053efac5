"""A rule: a stable code, the text of its page, two examples, and the check.

`@fleet_rule(...)` or `@text_rule(...)` above a function turns it into a `Rule`; `meshctl.lint.catalog` collects them.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from meshctl.diagnostics import Position, Severity
from meshctl.lint.context import LintContext
from meshctl.model import Fleet

CODE = re.compile(r"MC\d{3}")


@dataclass(frozen=True, slots=True)
class Finding:
    """A problem at a path of the inventory (or at an explicit `position`).

    Findings that differ only in the path are reported as one (a value that a group inherits), so a message does not
    repeat the node that the path names.
    """

    path: tuple[str, ...]
    message: str = ""
    expected: str = ""
    found: str = ""
    hint: str = ""
    position: Position | None = None


FleetCheck = Callable[[Fleet, LintContext], Iterator[Finding]]
TextCheck = Callable[[str, str], Iterator[Finding]]


@dataclass(frozen=True, slots=True)
class Example:
    """A fragment merged into the base inventory (`meshctl.lint.example`). `files` are written next to it,
    `environment` holds its secrets; `also` lists codes that necessarily occur together with the rule's own."""

    fragment: str
    files: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    also: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Rule:
    """`why` says what goes wrong in the field, `fix` what to do. Exactly one check is set, or none for findings of the
    engine itself (suppressions, the baseline). A fallback rule is silent where another rule reports. One that is per
    kind judges one node of each kind (`trial_rendering`): what it finds in its `extra_uci` is wrong in that of the
    others, too."""

    code: str
    severity: Severity
    title: str
    why: str
    fix: str
    failing: Example
    passing: Example
    check: FleetCheck | None = None
    check_text: TextCheck | None = None
    name: str = field(default="", kw_only=True)
    is_fallback: bool = field(default=False, kw_only=True)
    is_per_kind: bool = field(default=False, kw_only=True)


def fleet_rule(
    code: str,
    severity: Severity,
    title: str,
    *,
    why: str,
    fix: str,
    failing: str | Example,
    passing: str | Example,
    is_fallback: bool = False,
    is_per_kind: bool = False,
) -> Callable[[FleetCheck], Rule]:
    """Turn the decorated function, which checks a fleet, into a rule."""

    def decorate(check: FleetCheck) -> Rule:
        made = _rule(code, severity, title, why, fix, failing, passing, name=_slug(check), check=check)
        return replace(made, is_fallback=is_fallback, is_per_kind=is_per_kind)

    return decorate


def text_rule(
    code: str,
    severity: Severity,
    title: str,
    *,
    why: str,
    fix: str,
    failing: str | Example,
    passing: str | Example,
) -> Callable[[TextCheck], Rule]:
    """Turn the decorated function, which checks a file's name and text, into a rule; it runs even if loading fails."""

    def decorate(check: TextCheck) -> Rule:
        return _rule(code, severity, title, why, fix, failing, passing, name=_slug(check), check_text=check)

    return decorate


def engine_rule(
    code: str,
    severity: Severity,
    title: str,
    *,
    name: str,
    why: str,
    fix: str,
    failing: str | Example,
    passing: str | Example,
) -> Rule:
    """A rule that the engine itself checks."""
    return _rule(code, severity, title, why, fix, failing, passing, name=name)


def _rule(
    code: str,
    severity: Severity,
    title: str,
    why: str,
    fix: str,
    failing: str | Example,
    passing: str | Example,
    *,
    name: str,
    check: FleetCheck | None = None,
    check_text: TextCheck | None = None,
) -> Rule:
    if CODE.fullmatch(code) is None:
        raise ValueError(f"expected a rule code such as MC123, found {code}")
    return Rule(
        code,
        severity,
        title,
        _joined(why),
        _joined(fix),
        _example(failing),
        _example(passing),
        check,
        check_text,
        name=name,
    )


def _slug(check: Callable[..., object]) -> str:
    return check.__name__.replace("_", "-")


def _joined(text: str) -> str:
    """A triple-quoted text on one line."""
    return " ".join(text.split())


def _example(given: str | Example) -> Example:
    example = Example(given) if isinstance(given, str) else given
    return Example(inspect.cleandoc(example.fragment) + "\n", example.files, example.environment, example.also)
