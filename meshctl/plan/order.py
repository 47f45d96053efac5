"""The stages of a fleet's change, each with its nodes and its reason.

`stages_of` orders the nodes to change by the observed mesh: nodes outside any running mesh (nothing is cut), then
whole-mesh changes, then the running mesh from its far end, with each cut vertex alone, and the entry nodes last. If the
policy asks for it, the first stage of a kind is a canary. `stages_together` changes all nodes of running meshes in one
stage instead.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

from meshctl.model import ApplyPolicy
from meshctl.plan.independent import by_group
from meshctl.plan.values import Cut, NodePlan, Stage, StageKind
from meshctl.topology import Graph, Path
from meshctl.wording import counted

# A stage of more independent meshes does not repeat the reason of each.
_MAX_REASONS = 3
_LAST_OF_SEVERAL = "last, because each is the entry to its own mesh"


@dataclass(frozen=True, slots=True)
class MeshContext:
    """Inputs of the order besides the plans: the observed meshes, their entry nodes, the policy, the robots."""

    graph: Graph
    entries: tuple[str, ...]
    policy: ApplyPolicy
    robot_of: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    # node -> the meshes that depend on each other (`plan.independent`)
    groups_of: Mapping[str, frozenset[str]] = field(default_factory=lambda: MappingProxyType({}))


def stages_of(
    plans: Iterable[NodePlan], context: MeshContext, switches: Mapping[str, Sequence[str]] | None = None
) -> tuple[Stage, ...]:
    """The stages of these plans. `switches` maps meshes to the nodes that change their cell simultaneously."""
    switched = {name for nodes in (switches or {}).values() for name in nodes}
    todo = [plan for plan in plans if plan.node not in switched]
    rank = {name: position for position, name in enumerate(context.graph.farthest_first(*context.entries))}
    todo.sort(key=lambda plan: (rank.get(plan.node, -1), plan.node))
    free = [plan for plan in todo if not plan.is_meshed]
    harmless = [plan for plan in todo if plan.is_meshed and plan.cut <= Cut.LOGIN]
    cutting = [plan for plan in todo if plan.is_meshed and plan.cut > Cut.LOGIN]
    return (
        *_in_parallel(free, context.policy, "outside any running mesh: nothing in use is interrupted"),
        *(_switch(mesh, nodes, context) for mesh, nodes in (switches or {}).items()),
        *_in_parallel(harmless, context.policy, "interrupts nothing"),
        *_rolling(cutting, context),
    )


def stages_together(
    plans: Iterable[NodePlan], context: MeshContext, switches: Mapping[str, Sequence[str]] | None = None
) -> tuple[Stage, ...]:
    """The stages of these plans if all nodes of running meshes change simultaneously: first the nodes outside."""
    switched = {name for nodes in (switches or {}).values() for name in nodes}
    todo = sorted(plans, key=lambda plan: plan.node)
    free = [plan for plan in todo if not plan.is_meshed and plan.node not in switched]
    at_once = [plan for plan in todo if plan.is_meshed or plan.node in switched]
    meshes = tuple(dict.fromkeys(mesh for plan in at_once for mesh in plan.meshes))
    count = len(at_once)
    each = " of each mesh" if len(meshes) > 1 else ""
    stage = Stage(
        StageKind.TOGETHER,
        _entry_last((plan.node for plan in at_once), context),
        f"{counted(count, 'node')} simultaneously, rolled back unless {context.policy.quorum:.0%}{each} "
        "pass their checks",
        mesh=", ".join(meshes),
    )
    return (
        *_in_parallel(free, context.policy, "outside any running mesh: nothing in use is interrupted"),
        *((stage,) if at_once else ()),
    )


def _entry_last(names: Iterable[str], context: MeshContext) -> tuple[str, ...]:
    """The farthest first, the entry nodes last."""
    order = {name: position for position, name in enumerate(context.graph.farthest_first(*context.entries))}
    return tuple(sorted(names, key=lambda name: (name in context.entries, order.get(name, -1), name)))


def _in_parallel(plans: Sequence[NodePlan], policy: ApplyPolicy, reason: str) -> tuple[Stage, ...]:
    """All in one stage (the executor limits the parallelism), after a canary."""
    names = [plan.node for plan in plans]
    # factory devices need no canary: they have no configuration to lose
    if policy.canary and len(names) > 1 and any(plan.has_cell for plan in plans):
        first = Stage(StageKind.CANARY, (names[0],), f"canary: first alone; {reason}")
        return (first, Stage(StageKind.FREE, tuple(names[1:]), reason))
    return (Stage(StageKind.FREE, tuple(names), reason),) if names else ()


def _switch(mesh: str, nodes: Sequence[str], context: MeshContext) -> Stage:
    count = len(nodes)
    what = f"meshes {mesh} change their cells" if "," in mesh else f"mesh {mesh} changes its cell"
    return Stage(
        StageKind.SWITCH,
        _entry_last(nodes, context),
        f"{what}: {counted(count, 'node')} simultaneously, rolled back unless {context.policy.quorum:.0%} rejoin",
        mesh=mesh,
    )


def _rolling(plans: Sequence[NodePlan], context: MeshContext) -> tuple[Stage, ...]:
    """From the far end inward, in each independent mesh at most `max_down` at once and each cut vertex alone, the
    entries last."""
    paths = context.graph.paths_to_any(context.entries)
    cut_off_by = context.graph.cut_off_by_any(context.entries)
    waiting = [plan.node for plan in plans if plan.node not in context.entries]
    stays_up = {plan.node for plan in plans if plan.cut <= Cut.WEAK_LINKS}
    stages: list[Stage] = []
    if context.policy.canary and len(waiting) > 1:
        # the farthest node that is not a cut vertex
        canary = next((name for name in waiting if name not in cut_off_by), waiting[0])
        waiting.remove(canary)
        reason = f"canary: first alone; {_distance(canary, paths)}"
        stages.append(Stage(StageKind.CANARY, (canary,), reason, cut_off_by.get(canary, ())))
    parts = by_group(waiting, context.groups_of)
    while parts := [part for part in parts if part]:
        batches: list[tuple[str, ...]] = []
        for part in parts:
            batch = _batch(part, context, cut_off_by)
            if not _robots(batch, context) & _robots((name for taken in batches for name in taken), context):
                batches.append(batch)
                part[:] = [name for name in part if name not in batch]
        stages.append(_step(batches, cut_off_by, paths, stays_up))
    changing = {plan.node for plan in plans}
    stages += _entry_stages([entry for entry in context.entries if entry in changing], context)
    return tuple(stages)


def _step(
    batches: Sequence[tuple[str, ...]],
    cut_off_by: Mapping[str, tuple[str, ...]],
    paths: Mapping[str, Path],
    stays_up: Container[str],
) -> Stage:
    """One stage of these batches, each of another independent mesh."""
    reasons = [_batch_reason(batch, cut_off_by.get(batch[0], ()), paths, batch[0] in stays_up) for batch in batches]
    reason = reasons[0]
    if len(reasons) > _MAX_REASONS:
        reason = f"{len(batches)} independent meshes at the same time, each starting at its far end"
    elif len(reasons) > 1:
        reason = f"independent meshes at the same time: {'; '.join(reasons)}"
    nodes = tuple(name for batch in batches for name in batch)
    return Stage(
        StageKind.ROLLING, nodes, reason, tuple(lost for batch in batches for lost in cut_off_by.get(batch[0], ()))
    )


def _batch_reason(batch: Sequence[str], lost: Sequence[str], paths: Mapping[str, Path], stays_up: bool) -> str:
    if lost and stays_up:
        return f"alone, because it is a cut vertex: {', '.join(lost)} cannot be reached if a weak link breaks"
    if lost:
        return f"alone, because it is a cut vertex: while it is down {', '.join(lost)} cannot be reached"
    if len(batch) == 1:
        return _distance(batch[0], paths)
    return f"together, because they cut off no other node: {'; '.join(_distance(name, paths) for name in batch)}"


def _entry_stages(entries: Sequence[str], context: MeshContext) -> Iterator[Stage]:
    """The entries, those of independent meshes at the same time."""
    left = list(entries)
    while left:
        now: list[str] = []
        taken: set[str] = set()
        for entry in left:
            own = context.groups_of.get(entry) or frozenset({""})
            if not own & taken and not _robots((entry,), context) & _robots(now, context):
                now.append(entry)
                taken |= own
        left = [entry for entry in left if entry not in now]
        rest = {name for entry in now for name in context.graph.reachable(entry)} - set(now)
        reason = "last, because the mesh is reached through it" if len(now) == 1 else _LAST_OF_SEVERAL
        yield Stage(StageKind.LAST, tuple(now), reason, tuple(sorted(rest)))


def _robots(names: Iterable[str], context: MeshContext) -> set[str]:
    """The robots that these radios are of: with both radios of one down, the robot itself would be cut off."""
    return {context.robot_of.get(name, "") for name in names} - {""}


def _batch(waiting: Sequence[str], context: MeshContext, cut_off_by: Mapping[str, tuple[str, ...]]) -> tuple[str, ...]:
    batch = [waiting[0]]
    if waiting[0] in cut_off_by:
        return (waiting[0],)
    for name in waiting[1:]:
        if len(batch) >= max(1, context.policy.max_down):
            break
        if name in cut_off_by or _robots((name,), context) & _robots(batch, context):
            continue
        if not context.graph.cut_off_by_all(context.entries, [*batch, name]):
            batch.append(name)
    return tuple(batch)


def _distance(name: str, paths: Mapping[str, Path]) -> str:
    path = paths.get(name)
    if path is None:
        return f"{name} has no known path to the entry"
    return f"{name} is {counted(path.hops, 'hop')} away, quality {path.quality:.0%}"
