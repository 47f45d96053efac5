"""The peers that the core reaches over `RELAY_LINK`: the link, the targets of its heartbeats, when it is better than a
direct path, and how large datagrams on it may be."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from udp_mesh.core.path_mtu import update_mtu
from udp_mesh.core.peers.session import STALE_PATH_S
from udp_mesh.core.relaying.hop_channel import is_member
from udp_mesh.core.relaying.routes import HopRoute
from udp_mesh.core.sender.path import IP_UDP_BYTES, header_bytes
from udp_mesh.core.settings import MIN_LINK_MTU, RELAY_LINK, Address, LinkInfo, LinkKind, Neighbour
from udp_mesh.core.state import State
from udp_mesh.crypto import SHORT_OVERHEAD_BYTES
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.relay import CARRY_BYTES, VISITED_BYTES, Carry

HOLD_S = 3.0
"""A route through relays has to last this long before it replaces a direct path that works."""
MAX_PATHS = 1024
"""Nodes whose last path of relays is remembered."""


def relay_address(boot_id: bytes) -> Address:
    """The address on `RELAY_LINK` of a boot."""
    return boot_id[:HEARD_TAG_BYTES].hex(), 0


class RelayedPeers:
    """The core's view of nodes behind relays."""

    def __init__(self, state: State) -> None:
        self._state = state
        self._since: dict[bytes, float] = {}
        """Boot id -> when a route through relays became the best one."""
        self.paths: dict[bytes, tuple[bytes, ...]] = {}
        """First bytes of a boot id -> relays of the last datagram from it, the nearest first."""

    def is_in_use(self, boot_id: bytes) -> bool:
        """Whether the core sends to this boot through relays."""
        session = self._state.peer_table.sessions.get(boot_id)
        return session is not None and session.is_current and session.path.link == RELAY_LINK

    def _is_any_in_use(self) -> bool:
        """What the core sends to such a peer must end here, in the count of what was not reached."""
        return any(
            session.is_current and session.path.link == RELAY_LINK
            for session in self._state.peer_table.sessions.values()
        )

    def on_carried(self, carry: Carry) -> None:
        """Remember which relays a datagram for us came through."""
        self.paths.pop(carry.origin, None)
        self.paths[carry.origin] = carry.visited[::-1]
        if len(self.paths) > MAX_PATHS:
            del self.paths[next(iter(self.paths))]

    def has_common_key(self, route: HopRoute) -> bool:
        """Whether this node can be spoken to: it proved that it holds one of our fleet keys."""
        return is_member(self._state.keys, route.boot_id, route.proofs)

    def open_link(self) -> None:
        """Make `RELAY_LINK` available to the core, or fit it to changed links."""
        state = self._state
        mtus = [self._mtu(link.mtu, header_bytes(link.address)) for link in state.own_links()]
        if not mtus:
            return
        known = state.links.get(RELAY_LINK)
        if known is None or known.mtu != min(mtus):
            state.links[RELAY_LINK] = LinkInfo(RELAY_LINK, LinkKind.NEIGHBOURS, ("", 0), mtu=min(mtus))

    def _mtu(self, mtu: int, headers: int) -> int:
        """Size of IP packets that fit a carried datagram of an IP packet of `mtu` bytes, as the core counts them."""
        relays = self._state.settings.relay.hops - 1
        inner = mtu - headers - 1 - SHORT_OVERHEAD_BYTES - CARRY_BYTES - VISITED_BYTES * relays
        return max(MIN_LINK_MTU, inner + IP_UDP_BYTES)

    def sync(self, boot_ids: Iterable[bytes], routes: Mapping[bytes, HopRoute], active: bool, now: float) -> None:
        """Tell the core which of these nodes are reached through relays."""
        state = self._state
        if active:
            self.open_link()
        elif not state.relay_targets and not self._is_any_in_use():
            state.links.pop(RELAY_LINK, None)
        for boot_id in boot_ids:
            route = routes.get(boot_id)
            if route is None or route.direct or not self.has_common_key(route):
                self._since.pop(boot_id, None)
                state.relay_targets.pop(boot_id, None)
                continue
            since = self._since.setdefault(boot_id, now)
            session = state.peer_table.sessions.get(boot_id)
            if session is not None and session.path.link == RELAY_LINK:
                mtu = self._mtu(route.mtu, IP_UDP_BYTES)
                sender = None if session.peer is None else session.peer.sender
                narrowed = sender is not None and sender.pmtu.narrowed_at is not None
                if session.path.mtu > mtu or (session.path.mtu < mtu and not narrowed):
                    update_mtu(state, session, mtu)
            elif session is not None and now - session.path.heard_at < STALE_PATH_S and now - since < HOLD_S:
                continue
            if boot_id not in state.relay_targets:
                state.relay_targets[boot_id] = Neighbour(relay_address(boot_id), link=RELAY_LINK)
                state.heartbeats.schedule_now(len(state.peer_table.sessions), now)
