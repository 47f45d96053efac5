"""The current state of nodes that an earlier run left uncertain: its outcomes and a new plan -> one line per node."""

from __future__ import annotations

from collections.abc import Iterable

from meshctl.apply.next_action import reason_text
from meshctl.apply.participant import LEFT_BEHIND
from meshctl.apply.prepare import Prepared
from meshctl.device.observation import ChangeStatus
from meshctl.fleet import Outcome, Result
from meshctl.plan import Verdict


def resolutions(run_id: int, earlier: Iterable[Outcome], now: Prepared) -> dict[str, str]:
    """Node -> what became of it, for each that ended UNCERTAIN. Pure."""
    resolved = {}
    for outcome in earlier:
        plan = now.plan.nodes.get(outcome.node)
        if outcome.result is not Result.UNCERTAIN or plan is None:
            continue
        observation = now.observed.observations.get(outcome.node)
        match plan.verdict:
            case Verdict.SAME:
                what = "it matches the inventory"
            case Verdict.CHANGE:
                why = _why(None if observation is None else observation.change)
                what = f"it runs its previous state{why} and will change again"
            case Verdict.REFUSED:
                what = f"it answers and is refused: {plan.reason}"
            case Verdict.AWAY:
                what = "it is still unreachable" + _left(outcome)
        resolved[outcome.node] = f"uncertain after run {run_id}; now {what}"
    return resolved


def _why(change: ChangeStatus | None) -> str:
    if change is None or change.last_outcome != "restored":
        return ""
    return f" ({reason_text(change.last_reason)})"


def _left(outcome: Outcome) -> str:
    parted = outcome.facts.get(LEFT_BEHIND)
    if not parted:
        return ""
    return f": it is still in the old cell of its mesh ({parted}); reach it by cable or from another node in that cell"
