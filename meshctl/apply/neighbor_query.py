"""Observe the neighbors of nodes, for commands that concern those nodes alone: restore, replace, bootstrap.

A plan for a running mesh observes all of it (`prepare`). Here the neighbors a node hears are enough, and those it heard
when last seen, if that was recent enough for them to still hold its station entry.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from types import MappingProxyType

from meshctl.apply.stale_stations import MAX_QUERIED, current_neighbors
from meshctl.device.observation import Observation
from meshctl.fleet import Interrupt
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet
from meshctl.nodes.collect import collect, known_macs
from meshctl.nodes.connections import ConnectionPool
from meshctl.nodes.slots import nodes_in_work

# How long an 802.11s mesh keeps a peer it does not hear (IEEE80211_MESH_PEER_INACTIVITY_LIMIT, net/mac80211/mesh.h);
# an ad-hoc cell drops it within a minute.
REMEMBERED_S = 1800.0


def observe_neighbors(
    connections: ConnectionPool,
    fleet: Fleet,
    own: Mapping[str, Observation],
    known: Mapping[str, LastKnown],
    *,
    observations: Mapping[str, Observation] = MappingProxyType({}),
    interrupt: Interrupt | None = None,
) -> dict[str, Observation]:
    """The nodes' `own` observations and those of their reachable neighbors; `observations` holds those already made.

    Connections stay in the pool.
    """
    names = known_neighbors(fleet, own, known, now_s=time.time())
    nodes = [fleet.nodes[name] for name in names if name not in observations]
    collected = (
        collect(connections, nodes, parallel=nodes_in_work(fleet.apply.parallel), interrupt=interrupt)
        if nodes
        else None
    )
    return {**observations, **own, **(collected.observations if collected is not None else {})}


def known_neighbors(
    fleet: Fleet, observations: Mapping[str, Observation], known: Mapping[str, LastKnown], *, now_s: float
) -> tuple[str, ...]:
    """The other nodes that may hold a station entry of one of these. Pure."""
    names = known_macs(fleet, known)
    neighbors: list[str] = []
    for name, observation in observations.items():
        last = known.get(name)
        heard = () if last is None else last.facts.get("neighbours", "").split()
        is_recent = last is not None and now_s - last.seen_s < REMEMBERED_S
        former = [names[mac.lower()] for mac in heard if is_recent and mac.lower() in names]
        neighbors += [*current_neighbors(observation, names), *former][:MAX_QUERIED]
    return tuple(name for name in dict.fromkeys(neighbors) if name not in observations and name in fleet.nodes)
