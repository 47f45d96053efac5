"""A node's `Report` from its observation: its mesh MACs, the neighbors it hears and the link quality."""

from __future__ import annotations

from collections.abc import Mapping

from meshctl.device.observation import Observation, Originator
from meshctl.topology.observed import HeardNeighbor, Report

# batman-adv's transmit quality is one byte (BATMAN_IV).
TQ_MAX = 255
# BATMAN_V reports throughput instead: at this rate and above a link counts as perfect, since a 20 MHz channel shared by
# a team carries about as much (docs/facts/lab-facts.md).
FULL_THROUGHPUT_KBIT_S = 20_000


def report_of(node: str, observation: Observation) -> Report:
    """The node's report: from batman-adv's tables, or from the radio's station entries if there are none."""
    signals = {station.mac.lower(): station.signal_dbm for station in observation.stations or ()}
    if observation.neighbors is None:
        heard = [
            HeardNeighbor(station.mac.lower(), station.inactive_ms or 0, None, station.signal_dbm)
            for station in observation.stations or ()
            if station.can_forward
        ]
        return Report(node, mesh_macs(observation), tuple(heard))
    paths = _paths(observation.originators or ())
    return Report(
        node,
        mesh_macs(observation),
        tuple(
            _heard(mac, neighbor.last_seen_ms, signals.get(mac), paths.get(mac, {}))
            for neighbor in observation.neighbors
            for mac in (neighbor.mac.lower(),)
        ),
    )


def _heard(mac: str, last_seen_ms: int, signal_dbm: int | None, paths: Mapping[str, float]) -> HeardNeighbor:
    others = {originator: quality for originator, quality in paths.items() if originator != mac}
    return HeardNeighbor(mac, last_seen_ms, paths.get(mac), signal_dbm, others)


def mesh_macs(observation: Observation) -> tuple[str, ...]:
    """The MACs by which neighbors know it: those of batman-adv's hard interfaces, and of every mesh radio."""
    hard = observation.mesh.hard_interfaces if observation.mesh is not None else None
    macs = [(observation.macs or {}).get(name, "") for name in hard or ()]
    macs += [link.mac for link in observation.links or () if link.mode.lower() in ("ibss", "mesh point")]
    return tuple(dict.fromkeys(mac.lower() for mac in macs if mac))


def _paths(originators: tuple[Originator, ...]) -> dict[str, dict[str, float]]:
    """Next hop's MAC -> originator's MAC -> quality; the direct link where both are the same."""
    paths: dict[str, dict[str, float]] = {}
    for mac, next_hop, _, _, _, tq, throughput_kbit_s in originators:
        if tq is not None:
            value = tq / TQ_MAX
        elif throughput_kbit_s is not None:
            value = throughput_kbit_s / FULL_THROUGHPUT_KBIT_S
        else:
            continue
        best = paths.get(next_hop)
        if best is None:
            best = paths[next_hop] = {}
        known = best.get(mac, 0.0)
        best[mac] = known if known >= value else value if value < 1.0 else 1.0
    return paths
