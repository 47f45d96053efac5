"""A plan as text: totals, the stages in order with their reasons, the changes per node, and the totals again with the
nodes left out.

`plan_lines` yields plain text lines with a style name; the command line prints them, in color on a terminal.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from meshctl.plan import Cut, NodePlan, Plan, StageKind, Verdict
from meshctl.plan.ways import IN_ORDER, TOGETHER
from meshctl.report.changed_options import changed_lines, diff_lines, summary
from meshctl.report.duration import duration
from meshctl.report.line_wrap import wrap
from meshctl.report.terminal_escapes import clean
from meshctl.wording import counted, node_list

_MAX_ENTRIES = 4


class Line(NamedTuple):
    """`style` is a rich style, empty for plain text."""

    text: str
    style: str = ""
    is_diff: bool = False


def plan_lines(
    plan: Plan, *, with_diffs: bool = True, width: int | None = None, order: Iterable[str] = ()
) -> Iterator[Line]:
    """The whole plan, safe for a terminal. Nodes with the same changes share one block.

    Without `with_diffs`, changed settings are listed but diffs are not. Lines other than diffs are wrapped at `width`.
    `order` is the inventory's order of nodes.
    """
    for line in _plan_lines(plan, with_diffs=with_diffs, order=order):
        text = clean(line.text)
        for part in wrap(text, None if line.is_diff else width):
            yield line._replace(text=part)


def _entries(plan: Plan) -> str:
    more = len(plan.entries) - _MAX_ENTRIES
    return ", ".join(plan.entries[:_MAX_ENTRIES]) + (f" and {more} more" if more > 0 else "")


def _plan_lines(plan: Plan, *, with_diffs: bool, order: Iterable[str]) -> Iterator[Line]:
    yield Line(f"fleet {plan.fleet}: {_totals(plan)}", "bold")
    if plan.entries:
        yield Line(f"reached through {_entries(plan)}", "dim")
    if plan.stages:
        yield Line("")
        yield Line("order", "bold")
        yield from _stages(plan)
    if plan.ways:
        yield Line("")
        yield from _ways(plan)
    for note in plan.notes:
        yield Line(f"note: {note}", "yellow")
    places = {name: place for place, name in enumerate(order)}
    nodes = sorted(plan.nodes.values(), key=lambda node: places.get(node.node, len(places)))
    for group in _grouped(nodes, with_diffs=with_diffs):
        yield from _node(group, with_diffs=with_diffs)
    if len(nodes) > 1:
        yield from _closing_summary(plan, nodes)
    if plan.refusal:
        yield Line("")
        yield Line(f"refused: {plan.refusal}", "bold red")
        if plan.refusal_hint:
            yield Line(f"hint: {plan.refusal_hint}")


_WORDS = {
    Verdict.CHANGE: "to change",
    Verdict.SAME: "up to date",
    Verdict.AWAY: "away",
    Verdict.REFUSED: "refused",
}


def _totals(plan: Plan) -> str:
    counts = [(len(plan.of(verdict)), word) for verdict, word in _WORDS.items()]
    return ", ".join(f"{count} {word}" for count, word in counts if count) or "no node"


def _closing_summary(plan: Plan, nodes: Iterable[NodePlan]) -> Iterator[Line]:
    """The totals and the nodes left out, repeated since the first lines have scrolled off the screen."""
    yield Line("")
    yield Line(_totals(plan), "bold")
    groups: dict[tuple[Verdict, str], list[NodePlan]] = {}
    for node in nodes:
        if node.verdict in (Verdict.AWAY, Verdict.REFUSED):
            groups.setdefault((node.verdict, _common_reason(node)), []).append(node)
    for (verdict, common), group in groups.items():
        node = group[0]
        # the error of a failed connection starts with the node
        who = "" if node.reason.startswith(node.node) else f"{node.node}, "
        text = f"{who}{node.reason}"
        if len(group) > 1:
            text = f"{node_list([member.node for member in group])}: {common}"
        yield Line(f"  {verdict.value}: {text}", "yellow" if verdict is Verdict.AWAY else "red")


def _without_name(node: NodePlan) -> str:
    """The reason without the node: the error of a failed connection starts with it and its address."""
    address, colon, rest = node.reason.removeprefix(f"{node.node} (").partition("): ")
    return f"{address}: {rest}" if colon and node.reason.startswith(f"{node.node} (") else node.reason


def _common_reason(node: NodePlan) -> str:
    """The reason without what differs between nodes: their names and addresses, and where they were last seen."""
    reason = node.reason.removeprefix(node.node).lstrip(" ")
    if reason.startswith("("):
        reason = reason.partition("): ")[2]
    return reason.partition("; ")[0] if node.verdict is Verdict.AWAY else reason


def _stages(plan: Plan) -> Iterator[Line]:
    width = len(str(len(plan.stages)))
    for number, stage in enumerate(plan.stages, 1):
        names = ", ".join(stage.nodes)
        yield Line(f"  {number:>{width}}  {stage.kind.value:<8}{names}", "bold" if stage.cuts_off else "")
        yield Line(f"  {'':>{width}}          {stage.reason}", "dim")
        if stage.kind is StageKind.SWITCH:
            reasons: dict[str, list[str]] = {}
            for name in stage.nodes:
                why = ", ".join(plan.nodes[name].splits) if name in plan.nodes else ""
                reasons.setdefault(why or "changes with its mesh", []).append(name)
            for why, members in reasons.items():
                yield Line(f"  {'':>{width}}          {', '.join(members)}: {why}", "dim")


def _ways(plan: Plan) -> Iterator[Line]:
    """Both ways to execute the plan, and the recommended one."""
    chosen = TOGETHER if any(stage.kind is StageKind.TOGETHER for stage in plan.stages) else IN_ORDER
    yield Line(f"two ways ({plan.pace})", "bold")
    for way in plan.ways:
        mark = "this plan" if way.name == chosen else "--together" if way.name == TOGETHER else "without --together"
        stages = counted(way.stages, "stage")
        yield Line(
            f"  {way.name:<9} {mark}: {stages}, about {duration(way.estimated_s)}: {way.risk}",
            "" if way.name == chosen else "dim",
        )
    for way in plan.ways:
        if way.is_recommended:
            yield Line(f"  recommended: {way.name}, because {way.reason}", "" if way.name == chosen else "yellow")


def _grouped(nodes: Iterable[NodePlan], *, with_diffs: bool) -> Iterator[tuple[NodePlan, ...]]:
    """Nodes with the same changes, or the same reason for none, grouped, in the order of their first node."""
    groups: dict[object, list[NodePlan]] = {}
    for node in nodes:
        groups.setdefault(_effect_key(node, with_diffs=with_diffs), []).append(node)
    return (tuple(group) for group in groups.values())


def _effect_key(node: NodePlan, *, with_diffs: bool) -> object:
    if node.verdict is not Verdict.CHANGE:
        return node.verdict, node.reason, node.hint, node.notes if node.verdict is Verdict.SAME else ()
    return (
        *(node.cut, node.splits, node.firmware, node.packages, node.effects, node.notes),
        tuple(
            (change.path, change.kind, changed_lines(change) if with_diffs else summary(change))
            for change in node.files
        ),
    )


def _node(group: tuple[NodePlan, ...], *, with_diffs: bool) -> Iterator[Line]:
    node = group[0]
    match node.verdict:
        case Verdict.SAME:
            if node.notes:
                yield Line("")
                yield Line(f"{', '.join(member.node for member in group)}  up to date")
                yield from (Line(f"  note: {note}", "dim") for note in node.notes)
            return
        case Verdict.AWAY | Verdict.REFUSED:
            yield Line("")
            who = node.node if len(group) == 1 else f"{len(group)} nodes"
            style = "yellow" if node.verdict is Verdict.AWAY else "red"
            yield Line(f"{who}  {node.verdict.value}: {_without_name(node) if len(group) == 1 else node.reason}", style)
            if len(group) > 1:
                yield Line(f"  {', '.join(member.node for member in group)}")
            if node.hint:
                yield Line(f"  hint: {node.hint}")
            return
        case Verdict.CHANGE:
            pass
    yield Line("")
    if len(group) == 1:
        yield Line(f"{node.node}  cuts {node.cut.text}", "bold" if node.cut > Cut.LOGIN else "")
    else:
        yield Line(f"{len(group)} nodes  each cuts {node.cut.text}", "bold" if node.cut > Cut.LOGIN else "")
        yield Line(f"  {', '.join(member.node for member in group)}")
    for split in node.splits:
        yield Line(f"  leaves its mesh: {split}", "yellow")
    if node.firmware is not None:
        step = node.firmware
        yield Line(f"  firmware  {step.from_revision} -> {step.to_revision} ({step.image})")
    if node.packages is not None:
        yield Line(f"  packages  install {', '.join(node.packages.install)}")
        if node.packages.remove:
            yield Line(f"            remove {', '.join(node.packages.remove)}")
    for effect in node.effects:
        yield Line(f"  reloads   {effect.service}: {effect.why}; cuts {effect.cut.text}")
    for change in node.files:
        words = summary(change)
        yield Line(f"  {change.kind:<9} {change.path}" + (f": {words}" if words else ""))
        if with_diffs:
            yield from (_diff_line(text) for text in diff_lines(change))
    for note in node.notes:
        yield Line(f"  note: {note}", "dim")


def _diff_line(text: str) -> Line:
    style = {"+": "green", "-": "red", "@": "cyan"}.get(text[:1], "dim")
    return Line(f"    {text}", style, is_diff=True)


def question(plan: Plan) -> str:
    """The confirmation prompt for the plan."""
    todo = len(plan.of(Verdict.CHANGE))
    switched = sum(len(stage.nodes) for stage in plan.stages if stage.kind is StageKind.SWITCH)
    at_once = sum(len(stage.nodes) for stage in plan.stages if stage.kind is StageKind.TOGETHER)
    flashed = sum(1 for node in plan.nodes.values() if node.firmware is not None)
    extra = [
        f"{switched} change cell together" if switched else "",
        f"{at_once} simultaneously" if at_once else "",
        f"{flashed} get new firmware" if flashed else "",
    ]
    more = "; ".join(part for part in extra if part)
    return f"Change {counted(todo, 'node')}" + (f" ({more})" if more else "") + "?"
