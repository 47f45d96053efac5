"""Carried datagrams on their way: queued for their next hop, sent as far as its window allows, acknowledged.

`Forwarding` shares channels, neighbors, routes and counters with `relaying`.
"""

from __future__ import annotations

from collections.abc import Iterable

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.relaying.conditions import RelayCounters
from udp_mesh.core.relaying.hop_channel import HopChannels
from udp_mesh.core.relaying.hop_queue import QueueBudget, QueuedCarry
from udp_mesh.core.relaying.neighbors import HopNeighbor
from udp_mesh.core.relaying.routes import Routes
from udp_mesh.core.state import State
from udp_mesh.wire.limits import HEARD_TAG_BYTES
from udp_mesh.wire.relay import Carry, HopAck, encode_carry, encode_hop_ack

BATCH_BYTES = 65_536
"""Approximate maximum of one call of `send_queued`."""
_NEVER = float("inf")


class Forwarding:
    """The datagrams that wait for next hops, and the acknowledgments due to previous ones."""

    def __init__(self, state: State, channels: HopChannels, routes: Routes) -> None:
        self._state = state
        self._own = state.boot_id
        self._own_tag = state.boot_id[:HEARD_TAG_BYTES]
        self._channels = channels
        self._routes = routes
        self.budget = QueueBudget(state.boot_id)
        self.neighbors: dict[bytes, HopNeighbor] = {}
        self.counters = RelayCounters()
        self.tags: dict[bytes, bytes] = {}
        """First bytes of a boot id -> boot id, of selected routes."""
        self.ack_due: dict[bytes, None] = {}
        """Neighbors to which an acknowledgment is owed."""
        self.queued: dict[bytes, None] = {}
        """Neighbors to which something may be sent."""

    def may_pass(self, carry: Carry) -> bool:
        """Whether the configuration allows to pass this datagram on."""
        relay = self._state.settings.relay
        links = len(carry.visited) + 2
        if not relay.enabled or links > min(carry.max_hops, relay.hops):
            return False
        return relay.all or bool({self._name(carry.origin), self._name(carry.destination)} & set(relay.names))

    def _name(self, tag: bytes) -> str | None:
        boot_id = self.tags.get(tag)
        route = None if boot_id is None else self._routes.selected.get(boot_id)
        return None if route is None else route.name

    def queue(self, item: QueuedCarry) -> None:
        """Queue a datagram for its next hop."""
        boot_id = self.tags.get(item.carry.destination)
        route = None if boot_id is None else self._routes.selected.get(boot_id)
        neighbor = None if route is None else self.neighbors.get(route.via)
        if neighbor is None or neighbor.boot_id == item.previous:
            self.counters.dropped_unreachable += 1
            return
        neighbor.queue.push(item)
        self.queued[neighbor.boot_id] = None

    def accept(self, datagrams: Iterable[tuple[int, Datagram]], now: float) -> None:
        """Queue our own datagrams for nodes behind relays."""
        for priority, datagram in datagrams:
            assert datagram.destination is not None
            tag = bytes.fromhex(datagram.destination[0])
            carry = Carry(priority, max(2, self._state.settings.relay.hops), self._own_tag, tag, (), datagram.data)
            self.counters.sent += 1
            self.queue(QueuedCarry(carry, self._own, now))

    def send_acks(self, out: list[Datagram], own_round: int, now: float) -> None:
        for boot_id in list(self.ack_due):
            neighbor = self.neighbors.get(boot_id)
            if neighbor is not None and neighbor.ack_at > now:
                continue
            del self.ack_due[boot_id]
            link = None if neighbor is None else neighbor.best_link(own_round, now)
            if neighbor is None or link is None:
                continue
            delay_us = min((1 << 24) - 1, int((now - neighbor.largest_at) * 1e6))
            _, data = self._channels.seal(neighbor.hop, encode_hop_ack(HopAck(neighbor.largest, delay_us)))
            neighbor.unacknowledged, neighbor.ack_at = 0, _NEVER
            out.append(Datagram(link.name, link.address, data, True))

    def send_queued(self, out: list[Datagram], own_round: int, now: float, room: int) -> None:
        urgent_priority = self._state.settings.rates.urgent_priority
        first: list[Datagram] = []
        for boot_id in list(self.queued):
            neighbor = self.neighbors.get(boot_id)
            link = None if neighbor is None else neighbor.best_link(own_round, now)
            if neighbor is None or link is None:
                del self.queued[boot_id]
                continue
            dropped = neighbor.queue.dropped
            while neighbor.queue and room > 0:
                if neighbor.queue.first_level > urgent_priority and not neighbor.window.has_room:
                    break
                item = neighbor.queue.pop(now)
                if item is None:
                    break
                number, data = self._channels.seal(neighbor.hop, encode_carry(item.carry))
                neighbor.window.on_sent(number, now)
                urgent = item.carry.priority <= urgent_priority
                (first if urgent else out).append(Datagram(link.name, link.address, data, urgent))
                room -= len(data)
                if item.previous != self._own:
                    self.counters.passed_on += 1
                    self.counters.passed_on_bytes += item.size
            self.counters.dropped_queue += neighbor.queue.dropped - dropped
            if room > 0:
                # It waits for an acknowledgment, or has nothing more.
                del self.queued[boot_id]
        out[:0] = first
