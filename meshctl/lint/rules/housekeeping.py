"""Findings about suppressions and the baseline, reported by the engine itself (MC001 to MC004)."""

from __future__ import annotations

from meshctl.diagnostics import Severity
from meshctl.lint.rule import engine_rule

NO_REASON = engine_rule(
    "MC001",
    Severity.WARNING,
    "A suppression has no reason",
    name="suppression-without-reason",
    why="""Without a reason, it is unknown later whether the finding was considered or merely silenced. A
    suppression without a reason has no effect.""",
    fix="Add the reason after two hyphens: `# meshctl: ignore MC424 -- bench only, no radio is connected`.",
    failing="apply: {canary: true}  # meshctl: ignore MC614",
    passing="apply: {canary: false}  # meshctl: ignore MC614 -- every node of this fleet is on the bench",
)

UNUSED = engine_rule(
    "MC002",
    Severity.WARNING,
    "A suppression matches no finding",
    name="suppression-without-finding",
    why="""The finding was fixed or has moved to another line. If the comment stays, it hides the next finding on that
    line.""",
    fix="Remove the comment.",
    failing="apply: {canary: true}  # meshctl: ignore MC614 -- every node of this fleet is on the bench",
    passing="apply: {canary: true}",
)

UNKNOWN_CODE = engine_rule(
    "MC003",
    Severity.WARNING,
    "A suppression names an unknown rule",
    name="suppression-of-unknown-rule",
    why="A mistyped code suppresses nothing. The loader's own findings (INV...) cannot be suppressed.",
    fix="Use the code from the report, such as MC424; `meshctl lint --list` lists all codes.",
    failing="apply: {canary: true}  # meshctl: ignore MC999 -- every node of this fleet is on the bench",
    passing="apply: {canary: true}",
)

STALE_BASELINE = engine_rule(
    "MC004",
    Severity.NOTE,
    "The baseline contains a finding that no longer occurs",
    name="stale-baseline",
    why="The finding was fixed. If it stays in the baseline, the same fault can return unreported.",
    fix="Rewrite the baseline: `meshctl lint --baseline FILE --write-baseline`.",
    failing="apply: {canary: true}",
    passing="apply: {canary: false}",
)
