"""What lint says about its own comments and baseline; the engine finds these itself (MC001 to MC004)."""

from __future__ import annotations

from meshctl.diagnostics import Severity
from meshctl.lint.rule import engine_rule

NO_REASON = engine_rule(
    "MC001",
    Severity.WARNING,
    "A suppression gives no reason",
    name="suppression-without-reason",
    why="""Next year nobody knows whether the finding was weighed or only in the way. A suppression without a reason
    suppresses nothing.""",
    fix="Write why behind two hyphens: `# meshctl: ignore MC424 -- bench only, no radio is connected`.",
    failing="apply: {canary: true}  # meshctl: ignore MC614",
    passing="apply: {canary: false}  # meshctl: ignore MC614 -- every node of this fleet is on the bench",
)

UNUSED = engine_rule(
    "MC002",
    Severity.WARNING,
    "A suppression suppresses nothing",
    name="suppression-without-finding",
    why="What it excused was mended, or moved to another line: left standing, it hides the next real finding there.",
    fix="Remove the comment.",
    failing="apply: {canary: true}  # meshctl: ignore MC614 -- every node of this fleet is on the bench",
    passing="apply: {canary: true}",
)

UNKNOWN_CODE = engine_rule(
    "MC003",
    Severity.WARNING,
    "A suppression names no rule",
    name="suppression-of-unknown-rule",
    why="""A code with a slip of the pen suppresses nothing, and its author believes otherwise. The loader's own
    findings (INV...) cannot be suppressed.""",
    fix="Write the code as the report shows it, such as MC424; `meshctl lint --list` shows all.",
    failing="apply: {canary: true}  # meshctl: ignore MC999 -- every node of this fleet is on the bench",
    passing="apply: {canary: true}",
)

STALE_BASELINE = engine_rule(
    "MC004",
    Severity.NOTE,
    "The baseline holds a finding that is no longer found",
    name="stale-baseline",
    why="It was mended. Left in the baseline, it would let the same fault come back unseen.",
    fix="Write the baseline anew: `meshctl lint --baseline FILE --write-baseline`.",
    failing="apply: {canary: true}",
    passing="apply: {canary: false}",
)
