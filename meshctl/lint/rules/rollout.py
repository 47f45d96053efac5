"""Policy of changes: how many nodes at once, canary, quorum, when to stop (MC613 to MC616)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet


@fleet_rule(
    "MC613",
    Severity.WARNING,
    "Most of a mesh may be down at once",
    why="""With more than half of the nodes down at the same time, a bad change takes down the mesh and the way to
    repair it.""",
    fix="Lower `apply.max_down`: 1 is safe, a fifth of the mesh is usual.",
    failing="apply: {max_down: 3}",
    passing="apply: {max_down: 1}",
)
def max_down_large(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    sizes = group_by_key((mesh, node.name) for node in fleet.managed() for mesh in node.meshes)
    smallest = min((len(names) for names in sizes.values()), default=0)
    if smallest > 1 and fleet.apply.max_down > max(smallest // 2, 1):
        expected = f"at most {max(smallest // 2, 1)}"
        found = f"{fleet.apply.max_down} of {smallest} nodes"
        yield Finding(("apply", "max_down"), "a bad change takes down most of a mesh", expected, found)


@fleet_rule(
    "MC614",
    Severity.WARNING,
    "Changes are rolled out without a canary",
    why="Without a canary, a mistake reaches many nodes before the first one shows it.",
    fix="Set `apply.canary: true`.",
    failing="apply: {canary: false}",
    passing="apply: {canary: true}",
)
def no_canary(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.apply.canary and sum(1 for _ in fleet.managed()) > 1:
        yield Finding(("apply", "canary"), "a mistake reaches many nodes at once", "true", "false")


@fleet_rule(
    "MC615",
    Severity.WARNING,
    "The quorum is not more than one half",
    why="""A change of the whole cell is kept when the quorum rejoins. At one half or less, a split mesh counts as
    success, and its parts may keep different configurations.""",
    fix="Set `apply.quorum` to 0.6 or more.",
    failing="apply: {quorum: 0.4}",
    passing="apply: {quorum: 0.8}",
)
def quorum_low(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.apply.quorum <= 0.5:
        expected, found = "more than 0.5", f"{fleet.apply.quorum:g}"
        yield Finding(("apply", "quorum"), "a split mesh would count as success", expected, found)


@fleet_rule(
    "MC616",
    Severity.WARNING,
    "A run continues after many failures",
    why="""After the first failures, further ones of the same kind add no information, but each failed node has to be
    repaired by hand.""",
    fix="Set `apply.stop_after_failures` to 1 or 2.",
    failing="apply: {stop_after_failures: 10}",
    passing="apply: {stop_after_failures: 2}",
)
def stops_late(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if fleet.apply.stop_after_failures > 5:
        found = str(fleet.apply.stop_after_failures)
        yield Finding(("apply", "stop_after_failures"), "many nodes fail before the run stops", "at most 5", found)
