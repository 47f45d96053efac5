"""Changes that part a node from its mesh: which of them are a switch of the whole mesh, and whom that leaves behind.

A mesh whose members already run the cell to come takes strays back one by one. Otherwise all members that run another
cell change together, at one moment; members that do not answer would stay behind in the old cell, so they have to be
acknowledged by name.
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
class Switches:
    """`nodes`: mesh -> the nodes that change cell together. `left_behind`: mesh -> members that are off, not
    acknowledged. `blocked`: mesh -> members that answer and yet cannot take part, with the reason."""

    nodes: Mapping[str, tuple[str, ...]]
    left_behind: Mapping[str, tuple[str, ...]]
    blocked: Mapping[str, tuple[str, ...]]


def switches(
    fleet: Fleet,
    plans: Mapping[str, NodePlan],
    *,
    around: Mapping[str, NodePlan] = MappingProxyType({}),
    acknowledged: Iterable[str] = (),
    never_meshed: Iterable[str] = (),
) -> Switches:
    """The switches among these plans. `around` are members that were seen and to which nothing is done; `never_meshed`
    names nodes known to be in no cell yet (fresh from their box)."""
    known, fresh = set(acknowledged), set(never_meshed)
    nodes: dict[str, tuple[str, ...]] = {}
    left: dict[str, tuple[str, ...]] = {}
    blocked: dict[str, tuple[str, ...]] = {}
    for mesh in fleet.meshes:
        members = [plans[node.name] for node in fleet.members(mesh) if node.name in plans]
        parting = [plan for plan in members if plan.splits and plan.verdict is Verdict.CHANGE]
        beside = [around[node.name] for node in fleet.members(mesh) if node.name in around and node.name not in plans]
        staying = [plan for plan in (*members, *beside) if plan.has_cell and not plan.splits]
        # the mesh is where most of its members are; a few that differ from it come back to it
        if not parting or len(staying) >= len(parting):
            continue
        nodes[mesh] = tuple(plan.node for plan in parting)
        refused = [f"{plan.node}: {plan.reason}" for plan in members if plan.verdict is Verdict.REFUSED]
        flashed = [f"{plan.node}: its firmware changes too" for plan in parting if plan.firmware is not None]
        if refused or flashed:
            blocked[mesh] = (*refused, *flashed)
        there = {plan.node for plan in staying}
        unplanned = [node.name for node in fleet.members(mesh) if node.name not in plans and node.name not in there]
        away = [plan.node for plan in members if plan.verdict is Verdict.AWAY]
        behind = tuple(
            name
            for name in (*away, *unplanned)
            if name not in known and name not in fresh and fleet.nodes[name].state is not NodeState.SPARE
        )
        if behind and ALL not in known:
            left[mesh] = behind
    return Switches(nodes, left, blocked)
