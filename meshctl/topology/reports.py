"""A node's `Report` from its observation: its mesh MACs, the neighbors it hears and the link quality."""

from __future__ import annotations

from collections.abc import Iterable

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
    originators = observation.originators or ()
    direct = _direct_qualities(originators)
    return Report(
        node,
        mesh_macs(observation),
        tuple(
            HeardNeighbor(
                mac,
                neighbor.last_seen_ms,
                direct.get(mac),
                signals.get(mac),
                {} if mac in direct else _paths_through(mac, originators),
            )
            for neighbor in observation.neighbors
            for mac in (neighbor.mac.lower(),)
        ),
    )


def mesh_macs(observation: Observation) -> tuple[str, ...]:
    """The MACs by which neighbors know it: those of batman-adv's hard interfaces, and of every mesh radio."""
    hard = observation.mesh.hard_interfaces if observation.mesh is not None else None
    macs = [(observation.macs or {}).get(name, "") for name in hard or ()]
    macs += [link.mac for link in observation.links or () if link.mode.lower() in ("ibss", "mesh point")]
    return tuple(dict.fromkeys(mac.lower() for mac in macs if mac))


def _direct_qualities(originators: Iterable[Originator]) -> dict[str, float]:
    """The quality of the direct link to each neighbor, by MAC. A table has a row for each radio of a whole mesh: only
    those of neighbors are evaluated."""
    return _best((row.mac, row) for row in originators if row.mac == row.next_hop)


def _paths_through(mac: str, originators: Iterable[Originator]) -> dict[str, float]:
    """The quality of the path to each originator behind a neighbor, by MAC."""
    return _best((row.mac, row) for row in originators if row.next_hop == mac)


def _best(rows: Iterable[tuple[str, Originator]]) -> dict[str, float]:
    best: dict[str, float] = {}
    for mac, row in rows:
        if row.tq is not None:
            quality = row.tq / TQ_MAX
        elif row.throughput_kbit_s is not None:
            quality = row.throughput_kbit_s / FULL_THROUGHPUT_KBIT_S
        else:
            continue
        best[mac] = max(best.get(mac, 0.0), min(quality, 1.0))
    return best
