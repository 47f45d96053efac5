"""The fleet's plan from the nodes' plans and the observed mesh: its stages, and what prevents applying it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from types import MappingProxyType

from meshctl.model import Fleet
from meshctl.plan.cell import LEAVES_MESH
from meshctl.plan.independent import independent_meshes
from meshctl.plan.order import MeshContext, stages_of, stages_together
from meshctl.plan.switch import MeshSwitches, switches
from meshctl.plan.values import Cut, NodePlan, Plan, Stage, StageKind, Verdict
from meshctl.plan.ways import Pace, ways_of
from meshctl.topology import Graph
from meshctl.wording import MAX_IN_FULL, node_list


def fleet_plan(
    fleet: Fleet,
    plans: Mapping[str, NodePlan],
    graph: Graph,
    *,
    now_s: float,
    unchanged: Mapping[str, NodePlan] = MappingProxyType({}),
    entry: str = "",
    leave_behind: Iterable[str] = (),
    never_meshed: Iterable[str] = (),
    accept_cuts: Iterable[str] = (),
    together: bool = False,
    pace: Pace | None = None,
    returning: Mapping[str, float] = MappingProxyType({}),
) -> Plan:
    """The stages for these nodes. `entry` is the node through which the mesh is reached (default: the base
    of each node's site).

    `unchanged` are other members of their meshes, which show the cell that the mesh runs. `leave_behind` acknowledges
    nodes that are off during a change of their mesh, `accept_cuts` cut vertices that may be flashed; `all` means any.
    `together`: all nodes of running meshes change simultaneously. `pace` is that of earlier changes.
    `returning`: node -> until when (Unix time) it may roll back an unconfirmed change by itself.
    """
    entries = (entry,) if entry else tuple(fleet.bases_of(plans))
    acknowledged = tuple(leave_behind)
    found = switches(fleet, plans, unchanged=unchanged, acknowledged=acknowledged, never_meshed=never_meshed)
    robots = {node.name: node.robot for node in fleet.nodes.values()}
    surroundings = MeshContext(graph, entries, fleet.apply, robots, independent_meshes(fleet, graph, entries))
    todo = [plan for plan in plans.values() if plan.verdict is Verdict.CHANGE]
    in_order = stages_of(todo, surroundings, found.nodes)
    at_once = stages_together(todo, surroundings, found.nodes)
    stages = at_once if together else in_order
    cut_off_by = graph.cut_off_by_any(entries)
    refusal, hint = _refusal(
        found,
        plans,
        cut_off_by,
        frozenset(accept_cuts),
        acknowledged,
        {name: until_s for name, until_s in returning.items() if until_s > now_s},
    )
    if together and not refusal:
        refusal, hint = _refused_together(at_once, plans)
    windows = [fleet.nodes[plan.node].confirm_window_s for plan in todo]
    measured = pace or Pace()
    ways = (
        ()
        if any(plan.firmware is not None for plan in todo)
        else ways_of(in_order, at_once, plans, measured, quorum=fleet.apply.quorum, window_s=max(windows, default=0))
    )
    notes = [
        f"{name}: changes its cell alone ({', '.join(plans[name].splits)}): the others already run the inventory's"
        for name in plans
        if plans[name].verdict is Verdict.CHANGE
        and plans[name].splits
        and not any(name in nodes for nodes in found.nodes.values())
    ]
    notes += [
        f"stage {number}: {name} is a cut vertex: {', '.join(cut_off_by[name])} {_cut_off_for(plans[name])}"
        for number, stage in enumerate(stages, 1)
        if stage.cuts_off and stage.kind is not StageKind.LAST
        for name in stage.nodes
        if name in cut_off_by
    ]
    return Plan(
        fleet.name,
        now_s,
        entries,
        MappingProxyType(dict(plans)),
        stages,
        tuple(notes),
        refusal,
        hint,
        ways,
        measured.text if ways else "",
    )


def _cut_off_for(plan: NodePlan) -> str:
    """Whether, and how long, the nodes behind this one are cut off."""
    if any(split.endswith(LEAVES_MESH) for split in plan.splits):
        return "will be unreachable from then on, unless another node relays for them"
    return f"{'may' if plan.cut <= Cut.WEAK_LINKS else 'will'} be unreachable meanwhile"


def _refused_together(stages: Iterable[Stage], plans: Mapping[str, NodePlan]) -> tuple[str, str]:
    """Firmware cannot be part of a simultaneous change: the dead-man's switch does not undo a flash."""
    flashed = [
        name
        for stage in stages
        if stage.kind is StageKind.TOGETHER
        for name in stage.nodes
        if plans[name].firmware is not None
    ]
    if not flashed:
        return "", ""
    return (
        f"the firmware of {', '.join(flashed)} changes, and a flash cannot be rolled back with the others",
        "change firmware first, without --together; or leave it as it is with --no-firmware",
    )


def _folded(refused: Mapping[str, str]) -> str:
    """`b01, b02: no port eth1; b03: wrong board`: each reason once."""
    nodes: dict[str, list[str]] = {}
    for name, reason in refused.items():
        nodes.setdefault(reason, []).append(name)
    return "; ".join(f"{node_list(names)}: {reason}" for reason, names in nodes.items())


def _refusal(
    found: MeshSwitches,
    plans: Mapping[str, NodePlan],
    cut_off_by: Mapping[str, tuple[str, ...]],
    accepted: frozenset[str],
    acknowledged: tuple[str, ...],
    returning: Mapping[str, float],
) -> tuple[str, str]:
    for mesh, why in found.blocked.items():
        flashes = any(plan.firmware is not None and mesh in plan.parted_from for plan in plans.values())
        return (
            f"mesh {mesh} changes its cell, but not every member can take part: {_folded(why)}",
            "change firmware first, without changing the cell, and fix the refused nodes"
            if flashes
            else "fix the refused nodes, then plan again",
        )
    for mesh, names in found.left_behind.items():
        waiting = [name for name in names if name in returning]
        if waiting:
            # acknowledged, they would return to the old cell after the others have left it
            until = datetime.fromtimestamp(max(returning[name] for name in waiting), UTC)
            return (
                f"mesh {mesh} changes its cell, and {node_list(waiting)} may still roll back an earlier change, to the "
                "cell that the others would leave",
                f"plan again when they answer, or at the latest after {until:%H:%M:%S} UTC",
            )
        # one option with all of them, also those that were given already
        needed = (*acknowledged, *names)
        few = len(needed) <= MAX_IN_FULL
        how = ",".join(needed) if few else "and what selects them ('group:far,state:carried', @FILE, or all)"
        return (
            f"mesh {mesh} changes its cell and would leave behind {node_list(names)}: unreachable, or not "
            "part of this plan",
            f"switch them on and select them too, or acknowledge with --leave-behind {how}",
        )
    for name, plan in plans.items():
        if plan.firmware is not None and plan.is_meshed and cut_off_by.get(name) and not accepted & {name, "all"}:
            return (
                f"flashing {name} cuts off {', '.join(cut_off_by[name])}, permanently if it does not come back",
                f"give them another path first, or acknowledge with --accept-cut {name}",
            )
    return "", ""
