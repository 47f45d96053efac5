"""Look at those who may know a node's radio, where a command is about that node alone: restore, replace, bootstrap.

A plan for a running mesh looks at all of it (`planning`). Here whoever the node hears is enough, and whoever it heard
when it was last seen, if that is so short ago that they may still know it.
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

# So long an 802.11s mesh remembers whom it does not hear (IEEE80211_MESH_PEER_INACTIVITY_LIMIT, net/mac80211/mesh.h);
# an ad-hoc cell forgets within a minute.
REMEMBERED_S = 1800.0


def observe_neighbors(
    connections: ConnectionPool,
    fleet: Fleet,
    seen: Mapping[str, Observation],
    known: Mapping[str, LastKnown],
    *,
    observations: Mapping[str, Observation] = MappingProxyType({}),
    interrupt: Interrupt | None = None,
) -> dict[str, Observation]:
    """What these nodes told, and what those told who answer of their neighbours; `told` is what others told already.

    Connections stay with `access`.
    """
    names = known_neighbors(fleet, seen, known, now_s=time.time())
    nodes = [fleet.nodes[name] for name in names if name not in observations]
    collected = (
        collect(connections, nodes, parallel=max(1, fleet.apply.parallel), interrupt=interrupt) if nodes else None
    )
    return {**observations, **seen, **(collected.observations if collected is not None else {})}


def known_neighbors(
    fleet: Fleet, seen: Mapping[str, Observation], known: Mapping[str, LastKnown], *, now_s: float
) -> tuple[str, ...]:
    """The nodes beside these that may know one of them. Pure."""
    names = known_macs(fleet, known)
    neighbors: list[str] = []
    for name, observation in seen.items():
        last = known.get(name)
        heard = () if last is None else last.facts.get("neighbours", "").split()
        is_recent = last is not None and now_s - last.seen_s < REMEMBERED_S
        former = [names[mac.lower()] for mac in heard if is_recent and mac.lower() in names]
        neighbors += [*current_neighbors(observation, names), *former][:MAX_QUERIED]
    return tuple(name for name in dict.fromkeys(neighbors) if name not in seen and name in fleet.nodes)
