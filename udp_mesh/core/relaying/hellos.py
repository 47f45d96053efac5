"""Relay hellos: whether a node sends them, on which links and to whom, and in how many parts.

A node sends hellos while it relays, or hears a relay; on a link only if a node there announced that it understands
them, so that a fleet without relays, or of earlier versions, carries nothing more than before.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers.heartbeat import uses_link
from udp_mesh.core.relaying.hop_channel import HopChannels
from udp_mesh.core.relaying.neighbors import HopNeighbor, heard_on
from udp_mesh.core.sender.path import header_bytes
from udp_mesh.core.settings import RELAY_LINK, LinkInfo, LinkKind
from udp_mesh.core.state import State
from udp_mesh.crypto import LONG_OVERHEAD_BYTES
from udp_mesh.wire.frames import Feature
from udp_mesh.wire.limits import MAX_HEARD_HOPS, MAX_RELAYED_NODES
from udp_mesh.wire.relay import (
    HEARD_BYTES,
    HELLO_FIXED_BYTES,
    HeardHop,
    RelayedNode,
    RelayHello,
    encode_hello,
    encode_node,
)

MAX_PART_BYTES = 1152
"""Size of a part: fits IPv6's smallest MTU of 1,280 bytes."""


def hello_datagrams(
    state: State,
    channels: HopChannels,
    neighbors: Sequence[HopNeighbor],
    base: RelayHello,
    passes: Iterable[str] | None,
    now: float,
) -> Iterator[Datagram]:
    """The hellos of one round, on every link. `passes` names the nodes for which every path is open (None: all)."""
    named = None if passes is None else frozenset(passes)
    links = state.own_links()
    for link in links:
        here = [neighbor for neighbor in neighbors if link.name in neighbor.links]
        if not (here or state.settings.relay.keys or _is_understood(state, link.name)):
            continue
        targets = [
            neighbor.address
            for neighbor in state.settings.neighbours
            if not neighbor.legacy and uses_link(neighbor, link, links)
        ]
        if link.kind is LinkKind.NEIGHBOURS:
            targets += [neighbor.links[link.name].address for neighbor in here]
        heard = [
            heard_on(
                neighbor.links[link.name],
                neighbor,
                passes=base.relays and (named is None or neighbor.name in named),
                now=now,
            )
            for neighbor in here
        ]
        for part in _parts(base, heard, _room(link)):
            data = channels.seal_hello(encode_hello(part))
            if link.kind is LinkKind.BROADCAST:
                yield Datagram(link.name, link.broadcast, data, True)
            for address in dict.fromkeys(targets):
                yield Datagram(link.name, address, data, True)


def _is_understood(state: State, link: str) -> bool:
    """Whether a peer that is on this link, or reached through relays and perhaps here too, accepts relay datagrams."""
    return any(
        session.verified and session.path.link in (link, RELAY_LINK) and session.features & Feature.RELAY
        for session in state.peer_table.sessions.values()
    )


def _room(link: LinkInfo) -> int:
    return min(MAX_PART_BYTES, link.mtu - header_bytes(link.address) - LONG_OVERHEAD_BYTES - 1)


def _parts(base: RelayHello, heard: list[HeardHop], room: int) -> Iterator[RelayHello]:
    """The hello in parts that fit: first those heard, then the nodes."""
    room = max(HEARD_BYTES, room - HELLO_FIXED_BYTES)
    in_part, nodes_in_part = heard, list(base.nodes)
    while True:
        left = room
        now_heard: list[HeardHop] = []
        while in_part and len(now_heard) < MAX_HEARD_HOPS and left >= HEARD_BYTES:
            now_heard.append(in_part[0])
            in_part = in_part[1:]
            left -= HEARD_BYTES
        now_nodes: list[RelayedNode] = []
        while not in_part and nodes_in_part and len(now_nodes) < MAX_RELAYED_NODES:
            size = len(encode_node(nodes_in_part[0]))
            if size > left and (now_nodes or now_heard):
                break
            now_nodes.append(nodes_in_part.pop(0))
            left -= size
        yield RelayHello(
            base.name, base.relays, base.interval_ms, base.round, base.proofs, tuple(now_heard), tuple(now_nodes)
        )
        if not in_part and not nodes_in_part:
            return
