"""The two ways to execute a plan, with what each takes and risks, and the one to recommend. Pure.

`in order`: the stages of `plan.order.stages_of`. `together`: those of `stages_together`. Their times follow from the
pace of the fleet's earlier changes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

from meshctl.plan.values import Cut, NodePlan, Stage, StageKind, Way
from meshctl.wording import counted

IN_ORDER, TOGETHER = "in order", "together"
# A change of one node, if none was measured yet: three logins, the reload, the proof.
ASSUMED_CHANGE_S = 12.0
# Uploading and installing, with the reload and the proof; uploading, flashing and booting.
PACKAGES_S, FIRMWARE_S = 60.0, 300.0
# What each further node of a stage adds: logins and transfers share the channel (benchmarks.provisioning, 200 nodes).
NODE_SHARE_S = 0.2
# A simultaneous change arms in commands of its own, then waits for the scheduled moment (benchmarks.together).
SIMULTANEOUS_FACTOR = 2.5
# In order, a node is down itself, and once more without a path while the entry node changes.
USUAL_OUTAGES = 2
# An operator who waits that much longer wants to know of the other way.
LONG_S = 300.0


@dataclass(frozen=True, slots=True)
class Pace:
    """How long a change of one node's files takes: the median of the latest `measured` ones, or an assumption."""

    change_s: float = ASSUMED_CHANGE_S
    measured: int = 0

    @classmethod
    def of(cls, durations_s: Sequence[float]) -> Pace:
        """The pace of these changes."""
        # here, because it imports fractions and decimal, and most starts measure nothing
        from statistics import median

        return cls(median(durations_s), len(durations_s)) if durations_s else cls()

    @property
    def text(self) -> str:
        if not self.measured:
            return f"assuming {self.change_s:.0f} s per change"
        return f"from the latest {self.measured} changes, {self.change_s:.0f} s each"


def ways_of(
    in_order: Sequence[Stage],
    together: Sequence[Stage],
    plans: Mapping[str, NodePlan],
    pace: Pace,
    *,
    quorum: float,
    window_s: int,
) -> tuple[Way, ...]:
    """Both ways, one of them recommended; none if they do the same."""
    simultaneous = next((stage for stage in together if stage.kind is StageKind.TOGETHER), None)
    if simultaneous is None or len(simultaneous.nodes) < 2:
        return ()
    if any(stage.kind is StageKind.SWITCH and stage.nodes == simultaneous.nodes for stage in in_order):
        return ()
    rolling = Way(
        IN_ORDER,
        len(in_order),
        estimated_s(in_order, plans, pace),
        _outages(in_order, plans),
        _rolling_risk(in_order, plans),
    )
    count = len(simultaneous.nodes)
    interrupted = [plans[name].cut > Cut.LOGIN for name in simultaneous.nodes]
    if any(interrupted):
        affected = "all" if all(interrupted) else str(sum(interrupted))
        lost = f"{affected} of them are interrupted at the same moment, once"
    else:
        lost = "interrupts nothing"
    at_once = Way(
        TOGETHER,
        len(together),
        estimated_s(together, plans, pace),
        _outages(together, plans),
        f"{count} nodes change without a canary; {lost}; unless {quorum:.0%} pass their checks, all of them return to "
        f"their previous state, within {window_s} s",
    )
    return _recommended(rolling, at_once)


def estimated_s(stages: Iterable[Stage], plans: Mapping[str, NodePlan], pace: Pace) -> float:
    """How long these stages take, one after the other."""
    return sum(_stage_s(stage, [plans[name] for name in stage.nodes if name in plans], pace) for stage in stages)


def _stage_s(stage: Stage, plans: Sequence[NodePlan], pace: Pace) -> float:
    share_s = NODE_SHARE_S * max(0, len(plans) - 1)
    if stage.kind.is_simultaneous:
        # packages are installed before, one node after the other
        packages_s = PACKAGES_S * sum(plan.packages is not None for plan in plans)
        return packages_s + SIMULTANEOUS_FACTOR * pace.change_s + share_s
    return max((_node_s(plan, pace) for plan in plans), default=0.0) + share_s


def _node_s(plan: NodePlan, pace: Pace) -> float:
    if plan.firmware is not None:
        return FIRMWARE_S
    return (PACKAGES_S if plan.packages is not None else 0.0) + (pace.change_s if plan.reloads else 0.0)


def _outage_counts(stages: Iterable[Stage], plans: Mapping[str, NodePlan]) -> Counter[str]:
    """Node -> how often it is down, or has no path to the entry."""
    counts: Counter[str] = Counter()
    for stage in stages:
        counts.update(name for name in stage.nodes if name in plans and plans[name].cut > Cut.LOGIN)
        counts.update(stage.cuts_off)
    return counts


def _outages(stages: Iterable[Stage], plans: Mapping[str, NodePlan]) -> int:
    return max(_outage_counts(stages, plans).values(), default=0)


def _rolling_risk(stages: Sequence[Stage], plans: Mapping[str, NodePlan]) -> str:
    counts = _outage_counts(stages, plans)
    if not counts:
        lost = "interrupts nothing"
    else:
        ((worst, most),) = counts.most_common(1)
        lost = f"{worst} is interrupted or cut off {counted(most, 'time')}, no node more often"
    return f"{lost}; a failure stops the run, and the nodes before it keep the change"


def _recommended(rolling: Way, at_once: Way) -> tuple[Way, Way]:
    saved_s = rolling.estimated_s - at_once.estimated_s
    if rolling.outages > max(USUAL_OUTAGES, at_once.outages):
        reason = f"each node is interrupted at most {_times(at_once.outages)}, not {_times(rolling.outages)}"
        return rolling, replace(at_once, reason=reason)
    if saved_s > LONG_S:
        return rolling, replace(at_once, reason=f"it takes {saved_s / 60:.0f} minutes less")
    return replace(rolling, reason="a fault shows on few nodes, and the others keep working"), at_once


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
