"""Make a plan from the inventory and the observed fleet, with everything its execution needs.

`prepare`: render -> collect -> one plan per node -> observe the other members of meshes that are cut -> fleet plan.
The journal stores the facts of every observed node.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from meshctl.apply.commit_confirm import GRACE_AFTER_WINDOW_S
from meshctl.apply.images import CheckedImages
from meshctl.apply.reconnect import RELEARN_S, last_relays, reconnect
from meshctl.device.observation import Observation
from meshctl.diagnostics import InvalidInput
from meshctl.errors import InputError
from meshctl.fleet import Interrupt, Observer, silent
from meshctl.fleet.journal import Journal, LastKnown
from meshctl.model import Fleet, Node, NodeState
from meshctl.nodes.collect import FleetObservation, collect, facts_of, known_macs, login_place
from meshctl.nodes.connections import ConnectionPool, SshAddress
from meshctl.nodes.desired import Renderer
from meshctl.nodes.last_seen import MAX_QUERIED, last_seen_of
from meshctl.nodes.slots import nodes_in_work
from meshctl.plan import Cut, DesiredState, NodePlan, Plan, Verdict, fleet_plan, node_plan
from meshctl.plan.masking import Fingerprints
from meshctl.plan.observed_files import package_of
from meshctl.plan.ways import Pace
from meshctl.topology import mesh_macs


@dataclass(frozen=True, slots=True)
class PlanOptions:
    """The operator's options for a plan."""

    with_firmware: bool = True
    leave_behind: tuple[str, ...] = ()
    accept_cuts: tuple[str, ...] = ()
    entry: str = ""
    # all nodes of running meshes change simultaneously
    together: bool = False


@dataclass(frozen=True, slots=True)
class Prepared:
    """A plan, with the desired and observed states it was made from; `neighbor_observations` are of nodes that may hold
    station entries of these."""

    plan: Plan
    desired: Mapping[str, DesiredState] = field(repr=False)
    observed: FleetObservation = field(repr=False)
    salt: bytes = b""
    neighbor_observations: Mapping[str, Observation] = field(default_factory=dict, repr=False)


def prepare(
    renderer: Renderer,
    connections: ConnectionPool,
    nodes: Iterable[Node],
    journal: Journal,
    *,
    salt: bytes,
    owner: str,
    choices: PlanOptions | None = None,
    interrupt: Interrupt | None = None,
    observer: Observer = silent,
    reconnects: bool = False,
    tried: frozenset[str] = frozenset(),
) -> Prepared:
    """The plan for these nodes. Raises InvalidInput when one of them cannot be rendered.

    `reconnects`: neighbors that hear an unreachable node repair their links to it (`reconnect`), and it is tried again,
    except the nodes in `tried`. Where the plan cuts a running mesh, the whole mesh is observed: distances and cut
    vertices need all of it.
    """
    fleet = renderer.fleet
    signal = interrupt or Interrupt()
    chosen = tuple(nodes)
    rendered = {node.name: renderer.desired(node) for node in chosen}
    observed = collect(
        connections,
        chosen,
        parallel=nodes_in_work(fleet.apply.parallel),
        paths=lambda node: other_paths(rendered[node.name]),
        interrupt=signal,
        observer=observer,
    )
    _remember(journal, fleet, observed)
    decided = choices or PlanOptions()
    single = _node_plans(renderer, connections, rendered, observed, salt=salt, owner=owner, choices=decided)
    away = dict(observed.unreachable)
    rest = _other_members(fleet, single.plans.values()) or _former_neighbors(
        fleet, single.plans.values(), journal.last_known(fleet.name)
    )
    if rest and not signal.stopping:
        others = collect(
            connections,
            rest,
            parallel=nodes_in_work(fleet.apply.parallel),
            interrupt=signal,
            observer=observer,
        )
        _remember(journal, fleet, others)
        observed = replace(
            observed,
            observations={**observed.observations, **others.observations},
            silent_servers=observed.silent_servers | others.silent_servers,
        )
        away |= others.unreachable
        single = replace(single, unchanged=_unchanged_plans(renderer, others, salt, owner))
    if reconnects and away and not signal.stopping:
        owners = known_macs(fleet, journal.last_known(fleet.name))
        untried = {name: why for name, why in away.items() if name not in tried}
        unreached = replace(observed, unreachable=untried)
        repaired = reconnect(connections, fleet, unreached, owners, interrupt=signal, observer=observer)
        if repaired.nodes and not signal.stopping:
            signal.wait(RELEARN_S)
            again = prepare(
                renderer,
                connections,
                chosen,
                journal,
                salt=salt,
                owner=owner,
                choices=choices,
                interrupt=signal,
                observer=observer,
                reconnects=True,
                # the nodes behind these may be reachable now, and in the same state
                tried=tried | repaired.nodes,
            )
            return replace(again, plan=replace(again.plan, notes=(*repaired.notes, *again.plan.notes)))
    pace = Pace.of(journal.change_durations_s(fleet.name))
    return _with_fleet_plan(
        fleet,
        single,
        observed,
        journal.last_known(fleet.name),
        salt=salt,
        choices=decided,
        pace=pace,
        returning=_returning(fleet, away, journal),
    )


def _returning(fleet: Fleet, away: Iterable[str], journal: Journal) -> dict[str, float]:
    """Until when (Unix time) unreachable nodes may roll back a change whose end no run has observed."""
    ends = rollback_ends(fleet, journal)
    return {name: ends[name] for name in away if name in ends}


def rollback_ends(fleet: Fleet, journal: Journal) -> dict[str, float]:
    """Node -> when (Unix time) it has rolled back its latest change at the latest, if no run has observed the end."""
    window_s = max((node.confirm_window_s for node in fleet.managed()), default=0)
    started = journal.latest_unfinished(fleet.name, "apply")
    return {name: began_s + window_s + GRACE_AFTER_WINDOW_S for name, began_s in started.items()}


def _remember(journal: Journal, fleet: Fleet, observed: FleetObservation) -> None:
    facts = {name: facts_of(observation) for name, observation in observed.observations.items()}
    journal.remember_all(fleet.name, facts, time.time())


def _other_members(fleet: Fleet, plans: Iterable[NodePlan]) -> tuple[Node, ...]:
    """The other deployed nodes of meshes that one of these would cut, leave or rejoin."""
    planned = {plan.node: plan for plan in plans}
    meshes = {
        mesh
        for plan in planned.values()
        if plan.verdict is Verdict.CHANGE and (plan.splits or (plan.is_meshed and plan.cut > Cut.LOGIN))
        for mesh in plan.meshes
    }
    members = {node.name: node for mesh in sorted(meshes) for node in fleet.members(mesh)}
    return tuple(node for name, node in members.items() if name not in planned and node.state is NodeState.DEPLOYED)


def _former_neighbors(fleet: Fleet, plans: Iterable[NodePlan], known: Mapping[str, LastKnown]) -> tuple[Node, ...]:
    """Nodes that may hear the unreachable ones, or a relay between: their last known neighbors and paths, and their
    bases."""
    chosen = {plan.node: plan for plan in plans}
    macs = known_macs(fleet, known)
    away = [name for name, plan in chosen.items() if plan.verdict is Verdict.AWAY]
    near = [
        macs[mac]
        for name in away
        if name in known
        for mac in known[name].facts.get("neighbours", "").split()
        if mac in macs
    ]
    names = [
        name
        for name in dict.fromkeys((*near, *last_relays(away, known), *fleet.bases_of(away)))
        if name not in chosen and name in fleet.nodes
    ]
    return tuple(fleet.nodes[name] for name in names[:MAX_QUERIED])


def _unchanged_plans(renderer: Renderer, others: FleetObservation, salt: bytes, owner: str) -> dict[str, NodePlan]:
    """Plans of nodes that were not selected, to know which cell they run."""
    plans = {}
    for name, observation in others.observations.items():
        # a node that was not selected must not prevent the plan for the others
        with suppress(InvalidInput, InputError):
            desired = renderer.desired(renderer.fleet.nodes[name], observation)
            plans[name] = node_plan(desired, observation, Fingerprints(salt), owner=owner, with_firmware=False)
    return plans


def assemble(
    renderer: Renderer,
    connections: ConnectionPool,
    rendered: Mapping[str, DesiredState],
    observed: FleetObservation,
    known: Mapping[str, LastKnown],
    *,
    salt: bytes,
    owner: str,
    choices: PlanOptions,
) -> Prepared:
    """The plan from what was rendered without device facts (`rendered`) and what was observed."""
    single = _node_plans(renderer, connections, rendered, observed, salt=salt, owner=owner, choices=choices)
    return _with_fleet_plan(renderer.fleet, single, observed, known, salt=salt, choices=choices)


@dataclass(frozen=True, slots=True)
class _NodePlans:
    """The plan of each node; `unchanged`: plans of the other members of their meshes."""

    plans: Mapping[str, NodePlan]
    desired: Mapping[str, DesiredState] = field(repr=False)
    unchanged: Mapping[str, NodePlan] = field(default_factory=dict)


def _node_plans(
    renderer: Renderer,
    connections: ConnectionPool,
    rendered: Mapping[str, DesiredState],
    observed: FleetObservation,
    *,
    salt: bytes,
    owner: str,
    choices: PlanOptions,
) -> _NodePlans:
    fingerprints = Fingerprints(salt)
    desired: dict[str, DesiredState] = {}
    plans: dict[str, NodePlan] = {}
    images = CheckedImages()
    for name, want in rendered.items():
        observation = observed.observations.get(name)
        desired[name] = want if observation is None else renderer.desired(want.node, observation)
        made = node_plan(
            desired[name],
            observation,
            fingerprints,
            unreachable=observed.unreachable.get(name, ""),
            owner=owner,
            with_firmware=choices.with_firmware,
            own_keys=None if observation is None else connections.own_keys(want.node),
        )
        former = connections.former_places().get(name)
        if former is not None and observation is not None and login_place(facts_of(observation)) == former:
            made = replace(made, notes=(_reached_at(renderer.fleet, want.node, former), *made.notes))
        if made.firmware is not None and (faults := images.faults(want.node.hardware)):
            made = made.refused(faults, "correct the image or its hardware profile, or plan with --no-firmware")
        error = observed.refused.get(name)
        if error is not None:
            made = made.refused(str(error), error.hint)
        plans[name] = made
    return _NodePlans(plans, desired)


def _reached_at(fleet: Fleet, node: Node, former: SshAddress) -> str:
    """Where a node is that has not yet got its address or port."""
    address, port = former
    mesh = next((mesh.name for mesh in fleet.meshes.values() if address in mesh.network), "")
    place = f"{address} in the network of mesh {mesh}" if mesh and mesh not in node.meshes else str(address)
    gets = [] if address == node.address.ip else [f"the address {node.address.ip}"]
    if port != node.ssh.port:
        place += f", port {port}"
        gets.append(f"port {node.ssh.port}")
    return f"it is reached at {place}, where it was last seen, and gets {' and '.join(gets)}"


def _with_fleet_plan(
    fleet: Fleet,
    single: _NodePlans,
    observed: FleetObservation,
    known: Mapping[str, LastKnown],
    *,
    salt: bytes,
    choices: PlanOptions,
    pace: Pace | None = None,
    returning: Mapping[str, float] = MappingProxyType({}),
) -> Prepared:
    plans = dict(single.plans)
    away = [name for name, made in plans.items() if made.verdict is Verdict.AWAY]
    for name, place in last_seen_of(fleet, away, observed.observations, known).items():
        plans[name] = replace(plans[name], reason=f"{plans[name].reason}; {place.text(time.time())}")
    plan = fleet_plan(
        fleet,
        plans,
        observed.graph(fleet, known),
        now_s=time.time(),
        unchanged=single.unchanged,
        entry=choices.entry,
        leave_behind=choices.leave_behind,
        accept_cuts=choices.accept_cuts,
        together=choices.together,
        pace=pace,
        returning=returning,
        never_meshed=[name for name in single.plans if name in known and known[name].facts.get("cell") == "none"],
    )
    return Prepared(plan, single.desired, observed, salt)


def other_paths(desired: DesiredState) -> tuple[str, ...]:
    """The absolute paths of a node's files other than UCI packages."""
    return tuple(f"/{file.path}" for file in desired.files if package_of(file.path) is None)


def base_macs(
    fleet: Fleet, observations: Mapping[str, Observation], known: Mapping[str, LastKnown]
) -> dict[str, tuple[str, ...]]:
    """The mesh MACs of each base, by its name: observed now or last known."""
    found: dict[str, tuple[str, ...]] = {}
    for base in fleet.base_nodes:
        if base.name in observations:
            found[base.name] = mesh_macs(observations[base.name])
        elif base.name in known:
            found[base.name] = tuple(known[base.name].facts.get("macs", "").split())
    return found
