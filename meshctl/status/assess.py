"""From one look at the fleet to its status. Pure: observations, plans, what the journal knew, and the time in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from meshctl.device.observation import Observation
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Node, NodeState
from meshctl.plan import NodePlan
from meshctl.status.alarms import Seen, alarms, duration
from meshctl.status.values import Alarm, FleetStatus, Health, Level, Neighbour, NodeStatus
from meshctl.topology import NEIGHBOUR_FRESH_MS, Graph, Report, Sighting, report_of, seen_by


@dataclass(frozen=True, slots=True)
class Look:
    """One look at the fleet. `known` is what the journal knew before it; `macs` maps MACs to nodes; `silent` tells why
    a node gave no observation; `own_lock` is who we are to the nodes' locks."""

    fleet: Fleet
    observations: Mapping[str, Observation]
    silent: Mapping[str, str]
    plans: Mapping[str, NodePlan]
    graph: Graph
    known: Mapping[str, LastKnown]
    macs: Mapping[str, str]
    entry: str = ""
    own_lock: str = ""


def assess(look: Look, nodes: Iterable[Node], now: float) -> FleetStatus:
    """The status of these nodes at `now` (Unix time)."""
    reports = [report_of(name, seen) for name, seen in look.observations.items()]
    sightings = seen_by(reports, look.macs)
    paths = look.graph.paths(look.entry)
    cuts = look.graph.cut_off_by(look.entry)
    by_name = {report.node: report for report in reports}
    statuses = []
    for node in nodes:
        seen = look.observations.get(node.name)
        if seen is None:
            statuses.append(_silent(look, node, sightings.get(node.name, ()), now))
            continue
        last = look.known.get(node.name)
        everything = Seen(
            fleet=look.fleet,
            node=node,
            observation=seen,
            plan=look.plans.get(node.name),
            neighbours=_neighbours(by_name[node.name], look.macs),
            path=paths.get(node.name),
            cuts_off=cuts.get(node.name, ()),
            seconds_since_last_known=None if last is None else max(0.0, seen.answered_at_s - last.seen_s),
            own_lock=look.own_lock,
        )
        statuses.append(_answering(everything, now))
    names = set(look.macs.values()) | set(look.observations) | set(look.fleet.nodes)
    strangers = tuple(name for name in look.graph.nodes if name not in names)
    return FleetStatus(look.fleet.name, now, look.entry, tuple(statuses), strangers)


def _neighbours(report: Report, macs: Mapping[str, str]) -> tuple[Neighbour, ...]:
    """The neighbours of one node that were heard lately, the best first; one entry per node."""
    best: dict[str, Neighbour] = {}
    for heard in report.heard:
        name = macs.get(heard.mac, heard.mac)
        one = Neighbour(name, heard.last_seen_ms, heard.quality, heard.signal_dbm)
        if heard.last_seen_ms <= NEIGHBOUR_FRESH_MS and name != report.node:
            known = best.get(name)
            if known is None or (one.quality or 0.0) > (known.quality or 0.0):
                best[name] = one
    return tuple(sorted(best.values(), key=lambda one: (-(one.quality or 0.0), one.age_ms, one.name)))


def _silent(look: Look, node: Node, heard_by: tuple[Sighting, ...], now: float) -> NodeStatus:
    last = look.known.get(node.name)
    why = look.silent.get(node.name, "was not asked")
    found: tuple[Alarm, ...] = ()
    health = Health.OFF
    if node.state is NodeState.DEPLOYED:
        health = Health.UNREACHABLE
        told = f"last answered {duration(now - last.seen_s)} ago" if last else "has never answered"
        if heard_by:
            told += f", still heard by {heard_by[0].by} {heard_by[0].age_ms / 1000:.0f} s ago"
        found = (Alarm(Level.ERROR, "unreachable", f"{why}; {told}"),)
    elif heard_by:
        # switched on, in radio reach, and yet without an answer: worth a look before it is dropped
        health = Health.DEGRADED
        found = (Alarm(Level.WARNING, "mute", f"{why}, but {heard_by[0].by} hears it"),)
    return NodeStatus(
        node=node,
        health=health,
        alarms=found,
        age_s=None if last is None else now - last.seen_s,
        silent_because=why,
        version=last.facts.get("version", "") if last else "",
        revision=last.facts.get("revision", "") if last else "",
        heard_by=heard_by,
        last_known=last.facts if last else None,
    )


def _answering(seen: Seen, now: float) -> NodeStatus:
    told, plan = seen.observation, seen.plan
    found = alarms(seen)
    lan = next((bridge.ports for bridge in told.bridges or () if bridge.name == "br-lan"), None)
    return NodeStatus(
        node=seen.node,
        health=Health.DEGRADED if any(alarm.level > Level.NOTE for alarm in found) else Health.OK,
        alarms=found,
        age_s=max(0.0, now - told.answered_at_s),
        version=told.release.version if told.release else "",
        revision=told.release.revision if told.release else "",
        drift=None if plan is None else tuple(change.path for change in plan.files),
        uptime_s=told.uptime_s,
        memory_free=told.memory.available / told.memory.total if told.memory and told.memory.total else None,
        flash_free_bytes=told.overlay.free if told.overlay else None,
        clock_offset_s=told.clock_offset_s,
        channels=tuple(link.channel for link in told.links or () if link.channel is not None),
        tx_power_dbm=next((link.tx_power_dbm for link in told.links or () if link.tx_power_dbm is not None), None),
        lan_ports=lan,
        neighbours=seen.neighbours,
        hops=seen.path.hops if seen.path else None,
        quality=seen.path.quality if seen.path else None,
        via=seen.path.via if seen.path and seen.path.hops else "",
        is_cut_vertex=bool(seen.cuts_off),
    )
