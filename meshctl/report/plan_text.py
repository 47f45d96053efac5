"""A plan for a person: a line of totals, the stages in order with their reasons, then what happens to each node.

`plan_lines` gives plain text lines with a style name each; the command line prints them, coloured on a terminal.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from meshctl.plan import Cut, NodePlan, Plan, StageKind, Verdict


class Line(NamedTuple):
    """`style` is a rich style, empty for plain text."""

    text: str
    style: str = ""


def plan_lines(plan: Plan, *, with_diffs: bool = True) -> Iterator[Line]:
    """The whole plan. `with_diffs` False leaves out the files' contents."""
    yield Line(f"fleet {plan.fleet}: {_totals(plan)}", "bold")
    if plan.entry:
        yield Line(f"reached through {plan.entry}", "dim")
    if plan.stages:
        yield Line("")
        yield Line("order", "bold")
        yield from _stages(plan)
    for note in plan.notes:
        yield Line(f"note: {note}", "yellow")
    for node in plan.nodes.values():
        yield from _node(node, with_diffs=with_diffs)
    if plan.refusal:
        yield Line("")
        yield Line(f"refused: {plan.refusal}", "bold red")
        if plan.refusal_hint:
            yield Line(f"hint: {plan.refusal_hint}")


_WORDS = {
    Verdict.CHANGE: "to change",
    Verdict.SAME: "as wanted",
    Verdict.AWAY: "away",
    Verdict.REFUSED: "refused",
}


def _totals(plan: Plan) -> str:
    counts = [(len(plan.of(verdict)), word) for verdict, word in _WORDS.items()]
    return ", ".join(f"{count} {word}" for count, word in counts if count) or "no node"


def _stages(plan: Plan) -> Iterator[Line]:
    width = len(str(len(plan.stages)))
    for number, stage in enumerate(plan.stages, 1):
        names = ", ".join(stage.nodes)
        yield Line(f"  {number:>{width}}  {stage.kind.value:<8}{names}", "bold" if stage.cuts_off else "")
        yield Line(f"  {'':>{width}}          {stage.reason}", "dim")


def _node(node: NodePlan, *, with_diffs: bool) -> Iterator[Line]:
    match node.verdict:
        case Verdict.SAME:
            return
        case Verdict.AWAY | Verdict.REFUSED:
            yield Line("")
            yield Line(
                f"{node.node}  {node.verdict.value}: {node.reason}", "yellow" if node.verdict is Verdict.AWAY else "red"
            )
            if node.hint:
                yield Line(f"  hint: {node.hint}")
            return
        case Verdict.CHANGE:
            pass
    yield Line("")
    yield Line(f"{node.node}  cuts {node.cut.text}", "bold" if node.cut > Cut.LOGIN else "")
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
        yield Line(f"  {change.kind:<9} {change.path}")
        if with_diffs:
            yield from (_diff_line(text) for text in change.diff.splitlines()[2:])
    for note in node.notes:
        yield Line(f"  note: {note}", "dim")


def _diff_line(text: str) -> Line:
    style = {"+": "green", "-": "red", "@": "cyan"}.get(text[:1], "dim")
    return Line(f"    {text}", style)


def question(plan: Plan) -> str:
    """What a person is asked before the plan is applied."""
    todo = len(plan.of(Verdict.CHANGE))
    switched = sum(len(stage.nodes) for stage in plan.stages if stage.kind is StageKind.SWITCH)
    flashed = sum(1 for node in plan.nodes.values() if node.firmware is not None)
    extra = [f"{switched} change cell together" if switched else "", f"{flashed} get new firmware" if flashed else ""]
    told = "; ".join(part for part in extra if part)
    return f"Change {todo} node{'s' if todo != 1 else ''}" + (f" ({told})" if told else "") + "?"
