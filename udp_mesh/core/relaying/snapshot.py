"""The conditions of the relay layer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from udp_mesh.core.relaying.conditions import RelayConditions, RelayNeighbor, RelayRoute
from udp_mesh.core.relaying.hop_channel import is_member
from udp_mesh.core.relaying.neighbors import LINK_COST, HopNeighbor
from udp_mesh.core.relaying.routes import HopRoute
from udp_mesh.core.state import State
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.relay import VISITED_BYTES

if TYPE_CHECKING:
    from udp_mesh.core.relaying.relaying import Relaying


def snapshot(state: State, relaying: Relaying, now: float) -> RelayConditions:
    """See `Endpoint.relaying`."""
    names = relaying.routes.names() | {boot_id: neighbor.name for boot_id, neighbor in relaying.neighbors.items()}
    members = _members(state, relaying)
    routes = [
        _route(relaying, route, names, members) for route in relaying.routes.selected.values() if not route.direct
    ]
    return RelayConditions(
        relaying.relays,
        relaying.active(now),
        tuple(sorted(_neighbors(state, relaying, now), key=lambda neighbor: neighbor.name)),
        tuple(sorted(routes, key=lambda route: route.name)),
        replace(relaying.counters),
        relaying.queued_bytes,
    )


def _neighbors(state: State, relaying: Relaying, now: float) -> Iterator[RelayNeighbor]:
    for neighbor in relaying.neighbors.values():
        link = neighbor.best_link(relaying.round, now)
        yield RelayNeighbor(
            neighbor.name,
            None if link is None else link.name,
            neighbor.relays,
            is_member(state.keys, neighbor.boot_id, neighbor.proofs),
            0.0 if link is None else min(1.0, LINK_COST / link.cost(neighbor.interval_s, now)),
            neighbor.window.suspect,
            neighbor.queue.bytes,
            neighbor.window.packets,
            neighbor.window.rtt,
        )


def _members(state: State, relaying: Relaying) -> set[bytes]:
    """Boot ids of the nodes that hold one of our fleet keys."""
    known: list[HopNeighbor | HopRoute] = [*relaying.neighbors.values(), *relaying.routes.selected.values()]
    return {neighbor.boot_id for neighbor in known if is_member(state.keys, neighbor.boot_id, neighbor.proofs)}


def _route(relaying: Relaying, route: HopRoute, names: dict[bytes, str], members: set[bytes]) -> RelayRoute:
    marks = {boot_id[:VISITED_BYTES]: boot_id for boot_id in names}
    path = relaying.peers.paths.get(route.boot_id[:HEARD_TAG_BYTES], ())
    if not path or path[0] != route.via[:VISITED_BYTES]:
        # Heard the other way, or not yet: only the next hop is known.
        path = (route.via[:VISITED_BYTES],)
    relays = [marks.get(mark) for mark in path]
    return RelayRoute(
        route.name,
        tuple(mark.hex() if boot_id is None else names[boot_id] for mark, boot_id in zip(path, relays, strict=True)),
        route.hops,
        route.cost / LINK_COST,
        route.mtu,
        relaying.peers.has_common_key(route),
        tuple(names[boot_id] for boot_id in relays if boot_id in members and boot_id is not None),
        relaying.peers.is_in_use(route.boot_id),
    )
