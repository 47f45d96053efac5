"""Assess a snapshot: observations, last known facts and the time -> `FleetStatus`. Pure.

This module assesses the radios; `robots` assesses the robots.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from meshctl.device.observation import Observation
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node, NodeState
from meshctl.nodes.former_devices import former_devices
from meshctl.plan import NodePlan
from meshctl.report.duration import duration
from meshctl.robots.facts import RobotFacts
from meshctl.status.alarm_codes import FORMER_DEVICE
from meshctl.status.dropped import dropped_beacons
from meshctl.status.node_alarms import MESH_MODES, NodeAlarmInput, alarms, join_limited
from meshctl.status.radio_facts import neighbors_of, radios_of, snr_of, temperature_of
from meshctl.status.robots import RobotAnswers, robot_status
from meshctl.status.unreachable import NOT_ASKED, lost_relay_alarm, no_answer_alarm
from meshctl.status.values import Alarm, FleetStatus, Health, Level, NoAnswer, NodeStatus, health_of
from meshctl.topology import NEIGHBOR_FRESH_MS, Graph, Report, Sighting, heard_by_name, seen_by


@dataclass(frozen=True, slots=True)
class Snapshot:
    """The answers of all queried devices at one time.

    `known` are the facts in the journal before it, by node and by `robot.NAME`; `macs` maps MACs to nodes; `reports`
    are those of `observations`; `no_answer` and `no_answer_robots` hold the reasons for missing answers; `unrendered`
    why a node or `robot.NAME` could not be compared with the inventory; `own_lock` is our name in the nodes' locks;
    `robots_skipped` why no robot was queried.
    `is_partial`: only some nodes were queried, so paths and cut vertices are unknown.
    """

    fleet: Fleet
    observations: Mapping[str, Observation]
    no_answer: Mapping[str, NoAnswer]
    plans: Mapping[str, NodePlan]
    reports: Mapping[str, Report]
    graph: Graph
    known: Mapping[str, LastKnown]
    macs: Mapping[str, str]
    entry: str = ""
    own_lock: str = ""
    unrendered: Mapping[str, str] = field(default_factory=dict)
    robots: Mapping[str, RobotFacts] = field(default_factory=dict)
    no_answer_robots: Mapping[str, NoAnswer] = field(default_factory=dict)
    robots_skipped: str = ""
    unusable_workers: Mapping[str, NoAnswer] = field(default_factory=dict)
    """Site -> why its nodes were not queried by its worker, but from here."""
    previous: Mapping[str, Observation] = field(default_factory=dict)
    """The observations of the snapshot before, for what happened since."""
    is_partial: bool = False
    took_s: float = 0.0

    @property
    def entries(self) -> tuple[str, ...]:
        """The entry, and those of the other sites, whose meshes are apart."""
        others = (base.name for base in self.fleet.base_nodes)
        return tuple(dict.fromkeys((self.entry, *others))) if self.entry else ()

    @property
    def entry_by_site(self) -> dict[str, str]:
        """The entry of each site that has one; nodes of the others are looked for from `entry`."""
        first = self.fleet.base_node
        return {base.site: self.entry if base == first else base.name for base in self.fleet.base_nodes}


def assess(snapshot: Snapshot, nodes: Iterable[Node], now: float, robots: Iterable[str] = ()) -> FleetStatus:
    """The status of these radios and robots at `now` (Unix time)."""
    reports = snapshot.reports
    sightings = seen_by(reports.values(), snapshot.macs)
    refusals = _refusals(snapshot)
    names = set(snapshot.macs.values()) | set(snapshot.observations) | set(snapshot.fleet.nodes)
    formers = _formers_in_mesh(snapshot, names)
    paths = {} if snapshot.is_partial else snapshot.graph.paths_to_any(snapshot.entries)
    cut_off_by = {} if snapshot.is_partial else snapshot.graph.cut_off_by_any(snapshot.entries)
    entry_by_site = snapshot.entry_by_site
    heard = {name: heard_by_name(report, snapshot.macs) for name, report in reports.items()}
    snr = {name: snr_of(snapshot.observations[name], heard[name]) for name in reports}
    relays: dict[str, list[str]] = {}
    for name, path in paths.items():
        if path.hops and paths[path.via].hops:
            relays.setdefault(path.via, []).append(name)
    statuses = []
    for node in nodes:
        observation = snapshot.observations.get(node.name)
        if observation is None:
            heard_by, refused_by = sightings.get(node.name, ()), refusals.get(node.name, ())
            has_former = node.name in formers.values()
            statuses.append(_unreachable_status(snapshot, node, heard_by, now, refused_by, has_former=has_former))
            continue
        last = snapshot.known.get(node.name)
        # the robot that carries a beacon, and its rack, may use it as a relay while it is on board
        moving_with = snapshot.fleet.moving_with(node.name) | {node.name}
        everything = NodeAlarmInput(
            fleet=snapshot.fleet,
            node=node,
            observation=observation,
            plan=snapshot.plans.get(node.name),
            neighbors=neighbors_of(
                node,
                observation,
                heard[node.name],
                {other: snr[other].get(node.name) for other in heard[node.name] if other in snr},
            ),
            radios=radios_of(node, observation, snapshot.previous.get(node.name)),
            path=paths.get(node.name),
            is_path_known=entry_by_site.get(node.site, snapshot.entry) in paths,
            cuts_off=cut_off_by.get(node.name, ()),
            relays=tuple(name for name in relays.get(node.name, ()) if name not in moving_with),
            seconds_since_last_known=None if last is None else max(0.0, observation.answered_at_s - last.seen_s),
            own_lock=snapshot.own_lock,
        )
        statuses.append(_reachable_status(everything, now))
    if not snapshot.is_partial:
        statuses = _with_dropped(snapshot.fleet, statuses)
    strangers = tuple(name for name in snapshot.graph.nodes if name not in names | formers.keys())
    robot_answers = RobotAnswers(
        snapshot.fleet, snapshot.robots, snapshot.no_answer_robots, snapshot.known, now, frozenset(snapshot.unrendered)
    )
    return FleetStatus(
        snapshot.fleet.name,
        now,
        snapshot.entry,
        tuple(statuses),
        tuple(robot_status(robot_answers, snapshot.fleet.robots[name]) for name in robots),
        strangers,
        (*_fleet_alarms(snapshot), *_former_alarms(formers), *_site_alarms(snapshot, now)),
        snapshot.took_s,
    )


def _with_dropped(fleet: Fleet, statuses: list[NodeStatus]) -> list[NodeStatus]:
    """With a note for each beacon that appears to have been dropped and has no such alarm yet."""
    dropped = dropped_beacons(fleet, statuses)
    found = []
    for status in statuses:
        if status.name in dropped and not any(alarm.code == "dropped" for alarm in status.alarms):
            text = f"marked as carried, but {dropped[status.name]}"
            hint = f"if it has been dropped: meshctl deployed {status.name}, or --watch 30 to mark all by themselves"
            status = replace(status, alarms=(*status.alarms, Alarm(Level.NOTE, "dropped", text, hint)))
        found.append(status)
    return found


def _fleet_alarms(snapshot: Snapshot) -> Iterable[Alarm]:
    reasons: dict[str, list[str]] = {}
    for name, why in snapshot.unrendered.items():
        reasons.setdefault(why, []).append(name)
    for why, names in reasons.items():
        text = f"{join_limited(tuple(names))} not compared with the inventory: {why}"
        hint = "provide the missing secret, or fix the inventory (meshctl lint)"
        yield Alarm(Level.WARNING, "not-compared", text, hint, tuple(names))
    if snapshot.robots_skipped:
        yield Alarm(Level.NOTE, "robots-unasked", snapshot.robots_skipped)


def _formers_in_mesh(snapshot: Snapshot, names: set[str]) -> dict[str, str]:
    """MAC -> the node that the device was, of each former device that is in the mesh and is not one of `names`."""
    formers = former_devices(snapshot.known)
    return {mac: formers[mac] for mac in snapshot.graph.nodes if mac in formers and mac not in names}


def _former_alarms(found: Mapping[str, str]) -> Iterable[Alarm]:
    for mac, node in found.items():
        text = f"{mac} is in the mesh: the former device of {node}, which was replaced"
        hint = f"switch it off, or reset it to factory defaults: it has the address and the name of {node}"
        yield Alarm(Level.WARNING, FORMER_DEVICE, text, hint, (node,))


def _site_alarms(snapshot: Snapshot, now: float) -> Iterable[Alarm]:
    """One for each site that did not answer: how old the state is that is shown of it."""
    for site, why in sorted(snapshot.unusable_workers.items()):
        text = f"the nodes of site {site} were queried from here, not by its worker: {why.reason}"
        there = tuple(node.name for node in snapshot.fleet.nodes.values() if node.site == site)
        yield Alarm(Level.NOTE, "site", text, why.hint, there)
    silent: dict[str, list[str]] = {}
    for name, why in snapshot.no_answer.items():
        if why.of_gateway:
            silent.setdefault(snapshot.fleet.nodes[name].site, []).append(name)
    for site, names in sorted(silent.items()):
        why = snapshot.no_answer[names[0]]
        last_s = max((snapshot.known[name].seen_s for name in names if name in snapshot.known), default=None)
        nodes = f"its {len(names)} nodes" if len(names) > 1 else f"its node {names[0]}"
        if last_s is None:
            shown = f"nothing is known of {nodes}"
        else:
            shown = f"the last known state of {nodes} is {duration(max(0.0, now - last_s))} old"
        text = f"no contact with site {site} ({why.reason}): {shown}"
        yield Alarm(Level.WARNING, "site", text, why.hint, tuple(names))


def _refusals(snapshot: Snapshot) -> dict[str, tuple[Sighting, ...]]:
    """Node -> the nodes whose radios hear it, but have no 802.11s link to it."""
    found: dict[str, list[Sighting]] = {}
    for by, observed in snapshot.observations.items():
        for station in observed.stations or ():
            other = snapshot.macs.get(station.mac)
            # of a station that has not been heard at all, iw says 0 ms, and no signal
            is_heard = station.signal_dbm is not None and (station.inactive_ms or 0) <= NEIGHBOR_FRESH_MS
            if other is not None and is_heard and not station.can_forward:
                found.setdefault(other, []).append(Sighting(by, station.inactive_ms or 0, station.signal_dbm))
    return {name: tuple(seen) for name, seen in found.items()}


def _unreachable_status(
    snapshot: Snapshot,
    node: Node,
    heard_by: tuple[Sighting, ...],
    now: float,
    refused_by: tuple[Sighting, ...],
    *,
    has_former: bool,
) -> NodeStatus:
    """`has_former`: the device that it replaced is in the mesh."""
    last = snapshot.known.get(node.name)
    why = snapshot.no_answer.get(node.name, NOT_ASKED)
    is_required = node.state is NodeState.DEPLOYED
    alarm = no_answer_alarm(
        why,
        last,
        heard_by,
        now,
        is_required=is_required,
        trust=f"meshctl trust {node.name}",
        first_contact_hint=f"if it is not set up yet: meshctl bootstrap {node.name}",
        refused_by=refused_by,
    )
    if alarm is not None and why.code == "host-key" and has_former:
        alarm = replace(
            alarm, hint=f"the former device of {node.name} may answer in its place: switch that one off first"
        )
    lost_relay = lost_relay_alarm(node, why, last, now)
    found = tuple(text for text in (lost_relay, alarm) if text is not None)
    return NodeStatus(
        node=node,
        health=Health.UNREACHABLE if is_required else Health.DEGRADED if found else Health.OFF,
        alarms=found,
        age_s=None if last is None else now - last.seen_s,
        no_answer_reason=why.reason,
        heard_by=heard_by,
        last_known=last.facts if last else None,
    )


def _reachable_status(facts: NodeAlarmInput, now: float) -> NodeStatus:
    observed, plan = facts.observation, facts.plan
    memory = observed.memory
    found = alarms(facts)
    lan = next((bridge.ports for bridge in observed.bridges or () if bridge.name == "br-lan"), None)
    mesh_links = [link for link in observed.links or () if link.mode.lower() in MESH_MODES]
    return NodeStatus(
        node=facts.node,
        health=health_of(found),
        alarms=found,
        age_s=max(0.0, now - observed.answered_at_s),
        version=observed.release.version if observed.release else "",
        revision=observed.release.revision if observed.release else "",
        drift=None if plan is None else tuple(change.path for change in plan.files),
        uptime_s=observed.uptime_s,
        load=None if observed.load is None else observed.load.minute / observed.load.processors,
        processors=None if observed.load is None else observed.load.processors,
        memory_free=memory.available / memory.total if memory and memory.total else None,
        flash_free_bytes=observed.overlay.free if observed.overlay else None,
        clock_offset_s=observed.clock_offset_s,
        channels=tuple(dict.fromkeys(link.channel for link in mesh_links if link.channel is not None)),
        tx_power_dbm=next((link.tx_power_dbm for link in mesh_links if link.tx_power_dbm is not None), None),
        lan_ports=lan,
        lan_filter=observed.lan_filter,
        radios=facts.radios,
        temperature_c=temperature_of(observed),
        mesh_statistics=observed.mesh_statistics,
        mesh_tables=observed.mesh_tables,
        neighbors=facts.neighbors,
        is_path_known=facts.is_path_known,
        hops=facts.path.hops if facts.path else None,
        quality=facts.path.quality if facts.path else None,
        via=facts.path.via if facts.path and facts.path.hops else "",
        is_cut_vertex=bool(facts.cuts_off),
        relays=facts.relays,
    )
