"""Changes that part a node from its mesh: which of them are a switch of the whole mesh, and whom that leaves behind.

A mesh whose members already run the cell to come takes strays back one by one. Otherwise all members that run another
cell change together, at one moment; members that do not answer would stay behind in the old cell, so they have to be
acknowledged by name. A node's files change all at once: meshes that share a changing node are one switch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from meshctl.model import Fleet, NodeState
from meshctl.plan.values import NodePlan, Verdict

# Acknowledges whoever is off.
ALL = "all"


@dataclass(frozen=True, slots=True)
class MeshSwitches:
    """`nodes`: mesh, or meshes (`main, far`) -> the nodes that change cell together. `left_behind`: mesh -> members
    that are off, not acknowledged. `blocked`: mesh -> members that answer and yet cannot take part, with the reason."""

    nodes: Mapping[str, tuple[str, ...]]
    left_behind: Mapping[str, tuple[str, ...]]
    blocked: Mapping[str, tuple[str, ...]]


def switches(
    fleet: Fleet,
    plans: Mapping[str, NodePlan],
    *,
    unchanged: Mapping[str, NodePlan] = MappingProxyType({}),
    acknowledged: Iterable[str] = (),
    never_meshed: Iterable[str] = (),
) -> MeshSwitches:
    """The switches among these plans. `around` are members that were seen and to which nothing is done; `never_meshed`
    names nodes known to be in no cell yet (fresh from their box)."""
    known, new_nodes = set(acknowledged), set(never_meshed)
    nodes: dict[str, tuple[str, ...]] = {}
    left_behind: dict[str, tuple[str, ...]] = {}
    blocked: dict[str, tuple[str, ...]] = {}
    for mesh in fleet.meshes:
        members = [plans[node.name] for node in fleet.members(mesh) if node.name in plans]
        parting = [plan for plan in members if mesh in plan.parted_from and plan.verdict is Verdict.CHANGE]
        beside = [
            unchanged[node.name] for node in fleet.members(mesh) if node.name in unchanged and node.name not in plans
        ]
        staying = [plan for plan in (*members, *beside) if plan.has_cell and mesh not in plan.parted_from]
        # the mesh is where most of its members are; a few that differ from it come back to it
        if not parting or len(staying) >= len(parting):
            continue
        nodes[mesh] = tuple(plan.node for plan in parting)
        refused = [f"{plan.node}: {plan.reason}" for plan in members if plan.verdict is Verdict.REFUSED]
        flashed = [f"{plan.node}: its firmware changes too" for plan in parting if plan.firmware is not None]
        if refused or flashed:
            blocked[mesh] = (*refused, *flashed)
        staying_names = {plan.node for plan in staying}
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
    """Switches that share nodes as one, named after all of their meshes."""
    joined: list[tuple[tuple[str, ...], tuple[str, ...]]] = []
    for mesh, nodes in switching.items():
        sharing = [switch for switch in joined if set(switch[1]) & set(nodes)]
        joined = [switch for switch in joined if switch not in sharing]
        meshes = (*(name for names, _ in sharing for name in names), mesh)
        joined.append((meshes, tuple(dict.fromkeys((*(node for _, old in sharing for node in old), *nodes)))))
    return {", ".join(meshes): nodes for meshes, nodes in joined}
