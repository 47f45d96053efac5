"""Cell changes: which of them change a whole mesh simultaneously, and which nodes that leaves behind.

Nodes rejoin one by one a mesh whose other members already run the planned cell. Otherwise all members in another cell
change simultaneously; unreachable members would be left behind in the old cell, so they have to be acknowledged by
name. A node's files change all at once, so meshes that share a changing node change as one.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from meshctl.model import Fleet, NodeState
from meshctl.plan.values import NodePlan, Verdict

# Acknowledges any node that is off.
ALL = "all"


@dataclass(frozen=True, slots=True)
class MeshSwitches:
    """`nodes`: mesh, or meshes (`main, far`) -> the nodes that change cell together. `left_behind`: mesh -> members
    that are off and not acknowledged. `blocked`: mesh -> reachable members that cannot take part -> the reason."""

    nodes: Mapping[str, tuple[str, ...]]
    left_behind: Mapping[str, tuple[str, ...]]
    blocked: Mapping[str, Mapping[str, str]]


def switches(
    fleet: Fleet,
    plans: Mapping[str, NodePlan],
    *,
    unchanged: Mapping[str, NodePlan] = MappingProxyType({}),
    acknowledged: Iterable[str] = (),
    never_meshed: Iterable[str] = (),
) -> MeshSwitches:
    """The whole-mesh changes among these plans. `unchanged` are other observed members; `never_meshed` names nodes that
    were never in a cell (factory devices)."""
    known, new_nodes = set(acknowledged), set(never_meshed)
    nodes: dict[str, tuple[str, ...]] = {}
    left_behind: dict[str, tuple[str, ...]] = {}
    blocked: dict[str, dict[str, str]] = {}
    for mesh in fleet.meshes:
        members = [plans[node.name] for node in fleet.members(mesh) if node.name in plans]
        parting = [plan for plan in members if mesh in plan.parted_from and plan.verdict is Verdict.CHANGE]
        beside = [
            unchanged[node.name] for node in fleet.members(mesh) if node.name in unchanged and node.name not in plans
        ]
        staying = [plan for plan in (*members, *beside) if plan.has_cell and mesh not in plan.parted_from]
        departs = any(mesh in plan.departs for plan in parting)
        # the mesh is where most of its members are; the few that differ rejoin it one by one
        if not parting or (len(staying) >= len(parting) and not departs):
            continue
        nodes[mesh] = tuple(plan.node for plan in parting)
        refused = {plan.node: plan.reason for plan in members if plan.verdict is Verdict.REFUSED}
        flashed = {plan.node: "its firmware changes too" for plan in parting if plan.firmware is not None}
        if refused or flashed:
            blocked[mesh] = refused | flashed
        # members in the inventory's cell are where a rejoining node goes, and what a departing one leaves
        staying_names = {plan.node for plan in staying if not departs or plan.node in plans}
        unplanned = [
            node.name for node in fleet.members(mesh) if node.name not in plans and node.name not in staying_names
        ]
        away = [plan.node for plan in members if plan.verdict is Verdict.AWAY]
        behind = tuple(
            name
            for name in (*away, *unplanned)
            if name not in known and name not in new_nodes and fleet.nodes[name].state is not NodeState.SPARE
        )
        if behind and ALL not in known:
            left_behind[mesh] = behind
    return MeshSwitches(_joined(nodes), left_behind, blocked)


def _joined(switching: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Merge changes that share nodes, named after all of their meshes."""
    joined: list[tuple[tuple[str, ...], tuple[str, ...]]] = []
    for mesh, nodes in switching.items():
        sharing = [switch for switch in joined if set(switch[1]) & set(nodes)]
        joined = [switch for switch in joined if switch not in sharing]
        meshes = (*(name for names, _ in sharing for name in names), mesh)
        joined.append((meshes, tuple(dict.fromkeys((*(node for _, old in sharing for node in old), *nodes)))))
    return {", ".join(meshes): nodes for meshes, nodes in joined}
