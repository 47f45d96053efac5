"""Relay datagrams in and out: hellos to and from neighbors, datagrams for nodes behind relays, datagrams passed on.

1. `receive` opens a relay datagram of a neighbor. A hello changes links and routes. A carried datagram for this node
   goes to the core as if it had come over `RELAY_LINK`; another one is queued for its next hop.
2. `transmit` takes what the core sends over `RELAY_LINK`, queues it for its next hop, and empties the queues as far as
   each neighbor's window allows.
3. `handle_timer` sends hellos, declares datagrams of a hop lost, and forgets who is silent.

Only members (holders of the hop's key) are neighbors; one datagram in becomes at most one out, of the same size.
"""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Set as AbstractSet

from udp_mesh.core.events import PeerRouteChanged
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.receive import receive_datagram
from udp_mesh.core.relaying.forwarding import BATCH_BYTES, Forwarding
from udp_mesh.core.relaying.hellos import hello_datagrams
from udp_mesh.core.relaying.hop_channel import HopChannels, membership_proof
from udp_mesh.core.relaying.hop_queue import QueuedCarry
from udp_mesh.core.relaying.neighbors import MISSED_HELLOS, HopNeighbor, make_neighbor, on_hello
from udp_mesh.core.relaying.relayed_peers import RelayedPeers
from udp_mesh.core.relaying.routes import HopRoute, Routes
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.settings import RELAY_LINK, Address
from udp_mesh.core.state import State
from udp_mesh.crypto import Key
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.relay import VISITED_BYTES, Carry, HopAck, RelayHello, decode_relay

ACTIVE_FOR_S = 10.0
"""How long a node takes part after it last heard a relay."""
FORGET_S = 30.0
"""Silence after which a neighbor is forgotten."""
MAX_NEIGHBORS = 256
"""Neighbors at a time: only holders of the hop's key can invent them."""
MAINTENANCE_S = 0.5
MIN_HELLO_GAP_S = 0.2
ANSWER_WITHIN_S = 0.1
JITTER = 0.1
_NEVER = float("inf")


class Relaying:
    """The relay layer of one node; it does nothing in a fleet without relays."""

    def __init__(self, state: State, now: float) -> None:
        self._state = state
        self._own = state.boot_id
        self._own_tag = state.boot_id[:HEARD_TAG_BYTES]
        self._own_mark = state.boot_id[:VISITED_BYTES]
        self._channels = HopChannels(self._hop_keys(), state.boot_id)
        self.routes = Routes()
        self.forwarding = Forwarding(state, self._channels, self.routes)
        self.neighbors = self.forwarding.neighbors
        self.counters = self.forwarding.counters
        self.peers = RelayedPeers(state)
        self.round = 0
        self._out: list[Datagram] = []
        self._relay_heard_at = float("-inf")
        self._hello_at = now if self.relays else _NEVER
        self._hello_sent_at = float("-inf")
        self._maintenance_at = now + MAINTENANCE_S

    def _hop_keys(self) -> tuple[Key, ...]:
        return self._state.settings.relay.keys or self._state.keys

    @property
    def relays(self) -> bool:
        """Whether this node passes datagrams on."""
        return self._state.settings.relay.enabled

    @property
    def _max_hops(self) -> int:
        return self._state.settings.relay.hops

    @property
    def takes_part(self) -> bool:
        """Whether relay datagrams are accepted at all."""
        return self._max_hops > 1

    def active(self, now: float) -> bool:
        """Whether this node relays, or hears a relay."""
        return self.takes_part and (self.relays or now - self._relay_heard_at <= ACTIVE_FOR_S)

    # Settings

    def apply(self, now: float) -> None:
        """Take over changed settings and keys."""
        self._channels.set_keys(self._hop_keys())
        for boot_id, neighbor in self.neighbors.items():
            neighbor.hop = self._channels.add(boot_id)
        if self.relays:
            self._hello_soon(now)
        if not self.takes_part:
            for boot_id in list(self.neighbors):
                self._forget(boot_id)
        self._select(self.routes.known() | set(self.neighbors), now)

    # Receiving

    def receive(self, data: bytes | memoryview, link: str, source: Address, now: float) -> None:
        """Process one relay datagram. Never raises, whatever arrives."""
        if not self.takes_part or link not in self._state.links:
            self._state.event_queue.counters.dropped_malformed += 1
            return
        self._state.event_queue.counters.datagrams_received += 1
        self._state.event_queue.counters.bytes_received += len(data) + IP_UDP_BYTES
        known = len(self.neighbors)
        try:
            boot_id, is_hello, number, raw = self._channels.open(data)
            frame = decode_relay(raw)
        except DecodeError:
            self.counters.dropped_unauthenticated += 1
            self._state.event_queue.counters.dropped_unauthenticated += 1
            return
        neighbor = self.neighbors.get(boot_id)
        if is_hello != isinstance(frame, RelayHello) or (neighbor is None and not isinstance(frame, RelayHello)):
            self._state.event_queue.counters.dropped_malformed += 1
            return
        match frame:
            case RelayHello():
                if neighbor is None and known >= MAX_NEIGHBORS:
                    self._channels.forget(boot_id)
                else:
                    self._on_hello(neighbor, boot_id, frame, link, source, now)
            case HopAck(largest, delay_us):
                assert neighbor is not None
                neighbor.window.on_ack(largest, delay_us * 1e-6, now)
                if neighbor.queue:
                    self.forwarding.queued[boot_id] = None
            case Carry():
                assert neighbor is not None
                neighbor.on_carried(number, now)
                self.forwarding.ack_due[boot_id] = None
                self._on_carry(neighbor, frame, now)

    def _on_hello(
        self, neighbor: HopNeighbor | None, boot_id: bytes, hello: RelayHello, link: str, source: Address, now: float
    ) -> None:
        if neighbor is None:
            neighbor = make_neighbor(self._channels.add(boot_id), self.forwarding.budget)
            self.neighbors[boot_id] = neighbor
        before = neighbor.cost(self.round, now)
        info = self._state.links[link]
        hop_link = on_hello(neighbor, hello, self._own_tag, link, source, info.mtu, now)
        if hello.relays:
            self._relay_heard_at = now
            about = self.routes.on_offers(boot_id, hello.nodes, self._own, now)
        else:
            about = set()
        if not self.active(now):
            return
        if before is None or hop_link.echo < 0:
            # It may not know yet that we hear it.
            self._hello_soon(now)
        if before is None:
            about |= self.routes.known()
        self._select(about | {boot_id}, now)

    def _on_carry(self, previous: HopNeighbor, carry: Carry, now: float) -> None:
        if self._own_mark in carry.visited or carry.origin == self._own_tag:
            self.counters.dropped_loop += 1
        elif carry.destination == self._own_tag:
            self.counters.received += 1
            self.peers.on_carried(carry)
            self.peers.open_link()
            # It is counted as received once, by the core.
            counters = self._state.event_queue.counters
            counters.datagrams_received -= 1
            counters.bytes_received -= len(carry.datagram) + IP_UDP_BYTES
            receive_datagram(self._state, carry.datagram, RELAY_LINK, (carry.origin.hex(), 0), now)
        elif not self.forwarding.may_pass(carry):
            self.counters.dropped_refused += 1
        else:
            # A copy: the buffer of the datagram is used again.
            passed = carry._replace(datagram=bytes(carry.datagram), visited=(*carry.visited, self._own_mark))
            self.forwarding.queue(QueuedCarry(passed, previous.boot_id, now))

    # Sending

    def transmit(self, out: list[Datagram], now: float, room: int | None) -> list[Datagram]:
        """The core's datagrams, those over `RELAY_LINK` replaced by what leaves for next hops now."""
        state = self._state
        if RELAY_LINK in state.links:
            if any(datagram.link == RELAY_LINK for datagram in out):
                self.forwarding.accept([(0, datagram) for datagram in out if datagram.link == RELAY_LINK], now)
                out = [datagram for datagram in out if datagram.link != RELAY_LINK]
            if state.relayed:
                self.forwarding.accept(state.relayed, now)
                state.relayed.clear()
        if self._out:
            out.extend(self._out)
            self._out.clear()
        if self.forwarding.ack_due:
            self.forwarding.send_acks(out, self.round, now)
        if self.forwarding.queued:
            self.forwarding.send_queued(out, self.round, now, BATCH_BYTES if room is None else room)
        return out

    # Timers

    @property
    def has_work(self) -> bool:
        """Whether `transmit` may return something now."""
        return bool(self.forwarding.queued or self._out or self._state.relayed)

    def next_at(self) -> float:
        """When `handle_timer` or `transmit` is due next."""
        if not self.neighbors and self._hello_at == _NEVER:
            return _NEVER
        at = min(self._hello_at, self._maintenance_at)
        for boot_id in self.forwarding.ack_due:
            at = min(at, self.neighbors[boot_id].ack_at if boot_id in self.neighbors else at)
        for neighbor in self.neighbors.values():
            timeout_at = neighbor.window.timeout_at()
            if timeout_at is not None and timeout_at < at:
                at = timeout_at
        return at

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`."""
        for neighbor in self.neighbors.values():
            timeout_at = neighbor.window.timeout_at()
            if timeout_at is not None and timeout_at <= now:
                suspect = neighbor.window.suspect
                neighbor.window.on_timeout(now)
                if neighbor.queue:
                    self.forwarding.queued[neighbor.boot_id] = None
                if neighbor.window.suspect and not suspect:
                    self._select(self.routes.known(), now)
        if self._hello_at <= now:
            self._send_hellos(now)
        if self._maintenance_at <= now:
            self._maintenance_at = now + MAINTENANCE_S
            self._maintain(now)

    def _maintain(self, now: float) -> None:
        self._channels.age(now)
        for boot_id, neighbor in list(self.neighbors.items()):
            if now - neighbor.heard_at() > FORGET_S:
                self._forget(boot_id)
                continue
            for name, link in list(neighbor.links.items()):
                if name not in self._state.links or now - link.hello_at > FORGET_S:
                    del neighbor.links[name]
        self.routes.expire(self.neighbors, now)
        self.routes.forget_announced(now)
        if self.active(now) and self._hello_at == _NEVER:
            self._hello_soon(now)
        self._select(self.routes.known() | set(self.neighbors), now)

    def _forget(self, boot_id: bytes) -> None:
        neighbor = self.neighbors.pop(boot_id)
        self.counters.dropped_unreachable += len(neighbor.queue.drain())
        self._channels.forget(boot_id)
        self.forwarding.ack_due.pop(boot_id, None)
        self.forwarding.queued.pop(boot_id, None)

    def _hello_soon(self, now: float) -> None:
        soon = now + ANSWER_WITHIN_S * self._state.rng.random()
        self._hello_at = min(self._hello_at, max(self._hello_sent_at + MIN_HELLO_GAP_S, soon))

    def _send_hellos(self, now: float) -> None:
        if not self.active(now):
            self._hello_at = _NEVER
            return
        state, relay = self._state, self._state.settings.relay
        rates = state.settings.rates
        interval_s = max(rates.heartbeat_s, len(self.neighbors) / rates.heartbeats_heard_per_s)
        self.round += 1
        self._hello_sent_at = now
        self._hello_at = now + interval_s * (1 - JITTER * state.rng.random())
        opened = None if relay.all else dict.fromkeys(relay.names, True)
        nodes = self.routes.announce(relay.hops, opened) if self.relays else []
        base = RelayHello(
            state.settings.name,
            self.relays,
            min(65_535, int(interval_s * 1000)),
            self.round,
            tuple(membership_proof(key, self._own) for key in state.keys),
            (),
            tuple(nodes),
        )
        passes = None if relay.all else relay.names
        neighbors = [
            neighbor
            for neighbor in self.neighbors.values()
            if now - neighbor.heard_at() <= MISSED_HELLOS * neighbor.interval_s
        ]
        self._out.extend(hello_datagrams(state, self._channels, neighbors, base, passes, now))

    # Routes

    def _select(self, nodes: AbstractSet[bytes], now: float) -> None:
        """Choose routes again, tell the core, and move what waits for a next hop that is no longer used."""
        # The order of a set differs from process to process, and a simulation must not.
        boot_ids = sorted(nodes)
        changed = self.routes.select(boot_ids, self.neighbors, self.round, self._max_hops, now)
        for before, after in changed:
            if before is not None and after is None:
                self.forwarding.tags.pop(before.boot_id[:HEARD_TAG_BYTES], None)
            if after is not None:
                self.forwarding.tags[after.boot_id[:HEARD_TAG_BYTES]] = after.boot_id
        if changed and self.relays:
            self._hello_soon(now)
        self.peers.sync(boot_ids, self.routes.selected, self.active(now), now)
        for before, after in changed:
            self._on_changed(before, after)

    def _on_changed(self, before: HopRoute | None, after: HopRoute | None) -> None:
        old = self.neighbors.get(before.via) if before is not None else None
        if old is not None and old.queue:
            for item in old.queue.drain():
                self.forwarding.queue(item)
        if after is not None and not after.direct and self.peers.is_in_use(after.boot_id):
            via = self.neighbors[after.via].name
            self._state.event_queue.emit(PeerRouteChanged(after.name, via, after.hops))

    # Conditions

    def addresses(self) -> Iterable[tuple[str, Address]]:
        """Links and addresses of neighbors: a driver reads what comes from there as from peers."""
        for neighbor in self.neighbors.values():
            for link in neighbor.links.values():
                yield link.name, link.address

    @property
    def queued_bytes(self) -> int:
        return sum(neighbor.queue.bytes for neighbor in self.neighbors.values())
