"""From an inventory and the fleet as it is to a plan, with everything that carrying it out will need.

`prepare`: render -> gather -> one plan per node -> the fleet's order; the journal remembers what every node told.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from meshctl.apply.access import Access
from meshctl.apply.gather import Seen, facts_of, gather
from meshctl.apply.wanted import Renderer
from meshctl.apply.whereabouts import whereabouts
from meshctl.device.observation import Observation
from meshctl.fleet import Interrupt, Observer, silent
from meshctl.fleet.journal import Journal, LastKnown
from meshctl.model import Fleet, Node
from meshctl.plan import NodePlan, Plan, Verdict, Wanted, fleet_plan, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.plan.seen import package_of
from meshctl.topology import mesh_macs


@dataclass(frozen=True, slots=True)
class Choices:
    """What a person decided about a plan."""

    with_firmware: bool = True
    leave_behind: tuple[str, ...] = ()
    accept_cuts: tuple[str, ...] = ()
    entry: str = ""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A plan, and what was rendered and seen for it."""

    plan: Plan
    wanted: Mapping[str, Wanted] = field(repr=False)
    seen: Seen = field(repr=False)
    salt: bytes = b""


def prepare(
    renderer: Renderer,
    access: Access,
    nodes: Iterable[Node],
    journal: Journal,
    *,
    salt: bytes,
    owner: str,
    choices: Choices | None = None,
    interrupt: Interrupt | None = None,
    observer: Observer = silent,
) -> Prepared:
    """The plan for these nodes. Raises InvalidInput when one of them cannot be rendered."""
    fleet = renderer.fleet
    chosen = tuple(nodes)
    first = {node.name: renderer.wanted(node) for node in chosen}
    seen = gather(
        access,
        chosen,
        parallel=fleet.apply.parallel,
        paths=lambda node: other_paths(first[node.name]),
        interrupt=interrupt,
        observer=observer,
    )
    journal.remember_all(
        fleet.name, {name: facts_of(observation) for name, observation in seen.observations.items()}, time.time()
    )
    known = journal.last_known(fleet.name)
    return assemble(renderer, first, seen, known, salt=salt, owner=owner, choices=choices or Choices())


def assemble(
    renderer: Renderer,
    first: Mapping[str, Wanted],
    seen: Seen,
    known: Mapping[str, LastKnown],
    *,
    salt: bytes,
    owner: str,
    choices: Choices,
) -> Prepared:
    """The plan for what was rendered without the devices' facts (`first`) and what was seen."""
    fleet = renderer.fleet
    fingerprints = Fingerprints(salt)
    wanted: dict[str, Wanted] = {}
    plans: dict[str, NodePlan] = {}
    for name, want in first.items():
        observation = seen.observations.get(name)
        wanted[name] = want if observation is None else renderer.wanted(want.node, observation)
        made = node_plan(
            wanted[name],
            observation,
            fingerprints,
            away=seen.away.get(name, ""),
            owner=owner,
            with_firmware=choices.with_firmware,
        )
        error = seen.refused.get(name)
        if error is not None:
            made = replace(made, verdict=Verdict.REFUSED, reason=str(error), hint=error.hint)
        plans[name] = made
    away = [name for name, made in plans.items() if made.verdict is Verdict.AWAY]
    for name, place in whereabouts(fleet, away, seen.observations, known).items():
        plans[name] = replace(plans[name], reason=f"{plans[name].reason}; {place.text(time.time())}")
    plan = fleet_plan(
        fleet,
        plans,
        seen.graph(fleet, known),
        now_s=time.time(),
        entry=choices.entry,
        leave_behind=choices.leave_behind,
        accept_cuts=choices.accept_cuts,
        never_meshed=[name for name in plans if name in known and known[name].facts.get("cell") == "none"],
    )
    return Prepared(plan, wanted, seen, salt)


def other_paths(wanted: Wanted) -> tuple[str, ...]:
    """The absolute paths of a node's files that are no UCI packages."""
    return tuple(f"/{file.path}" for file in wanted.files if package_of(file.path) is None)


def base_macs(fleet: Fleet, seen: Mapping[str, Observation], known: Mapping[str, LastKnown]) -> tuple[str, ...]:
    """The mesh MACs of the base's radio, seen now or known from before."""
    base = fleet.base_node
    if base is None:
        return ()
    if base.name in seen:
        return mesh_macs(seen[base.name])
    return tuple(known[base.name].facts.get("macs", "").split()) if base.name in known else ()
