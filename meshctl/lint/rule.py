"""What a rule is: a stable code, the words of its page, two examples, and the function that looks.

A rule's module writes `@fleet_rule(...)` (or `@text_rule(...)`) above a function; the decorated name then holds the
`Rule`. `meshctl.lint.catalog` gathers them.
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
    """What a rule saw: the place as the inventory's path (or a `position` of its own), and what is wrong there.

    Findings that differ in nothing but the path are reported as one (a value that a whole group inherits), so a
    message names no node that its path already names.
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
    """A fragment laid over the base inventory (`meshctl.lint.example`). `files` stand beside it, `environment` holds
    the variables its secrets name; `also` are codes that cannot but come with the rule's own."""

    fragment: str
    files: Mapping[str, str] = field(default_factory=dict)
    environment: Mapping[str, str] = field(default_factory=dict)
    also: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Rule:
    """`why` says what goes wrong in the field, `fix` what to do; exactly one of the checks is set, or none for what
    the engine itself reports (suppressions, the baseline). A fallback is silent where another rule has spoken."""

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
) -> Callable[[FleetCheck], Rule]:
    """Make the decorated function, which reads a fleet, a rule."""

    def decorate(check: FleetCheck) -> Rule:
        made = _rule(code, severity, title, why, fix, failing, passing, name=_slug(check), check=check)
        return replace(made, is_fallback=is_fallback)

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
    """Make the decorated function, which reads a file's name and text, a rule; it runs even when no fleet loads."""

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
    """A rule that the engine checks by itself."""
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
        raise ValueError(f"a rule's code is MC and three digits, not {code}")
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
    """A triple-quoted text as one paragraph."""
    return " ".join(text.split())


def _example(given: str | Example) -> Example:
    example = Example(given) if isinstance(given, str) else given
    return Example(inspect.cleandoc(example.fragment) + "\n", example.files, example.environment, example.also)
