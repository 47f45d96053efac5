"""Nodes with several links on several networks, in virtual time: topologies for relays.

A network reaches its members with one broadcast; each of its members has an output queue there that is drained at the
network's rate. Losses are per receiver. Everything follows from the seed.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import partial

from udp_mesh.core.conditions import Conditions
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event, MessageId, Rejected
from udp_mesh.core.interfaces import Background, Datagram, Store, in_foreground
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.settings import Address, LinkInfo, LinkKind, Settings
from udp_mesh.sim.event_queue import SimEventQueue

_MIN_STEP_S = 1e-6


@dataclass(slots=True)
class SimNetwork:
    """One broadcast domain: a radio mesh, a tether. `losses` overrides `loss` for (from, to).

    A datagram is delayed by up to `jitter_s` more, so that later ones may overtake it, and arrives twice with the
    probability `duplicates`.
    """

    name: str
    number: int
    rate_bits_per_s: float = 10e6
    delay_s: float = 0.005
    loss: float = 0.0
    queue_packets: int = 100
    mtu: int = 1500
    up: bool = True
    jitter_s: float = 0.0
    duplicates: float = 0.0
    members: list[str] = field(default_factory=list)
    losses: dict[tuple[str, str], float] = field(default_factory=dict)
    carried_bytes: int = 0
    dropped: int = 0

    def address(self, name: str) -> Address:
        return f"10.{self.number}.0.{self.members.index(name) + 1}", 8700

    @property
    def broadcast(self) -> Address:
        return f"10.{self.number}.255.255", 8700


class Topology:
    """`events` has what each node reported, with the time; `on_datagram` sees every datagram sent on a network.

    Each node has a clock of its own, `clock(name)`, `clocks[name]` ahead of the virtual time.
    """

    def __init__(self, seed: int = 1) -> None:
        self.event_queue = SimEventQueue()
        self.networks: dict[str, SimNetwork] = {}
        self.nodes: dict[str, Endpoint] = {}
        self.events: dict[str, list[tuple[float, Event]]] = {}
        self.on_datagram: Callable[[str, str, Datagram, float], None] | None = None
        self.on_event: Callable[[str, Event, float], None] | None = None
        self.rng = random.Random(seed)
        self.clocks: dict[str, float] = {}
        self.timers_late_s = 0.0
        """The timers of busy computers come up to this late."""
        self._busy_until: dict[tuple[str, str], float] = {}
        self._wakes_at: dict[str, float] = {}

    @property
    def now(self) -> float:
        return self.event_queue.now

    def clock(self, name: str) -> float:
        """The time on a node's clock."""
        return self.now + self.clocks.get(name, 0.0)

    def add_network(self, network: SimNetwork) -> SimNetwork:
        self.networks[network.name] = network
        return network

    def network(self, name: str, **values: float) -> SimNetwork:
        """A new network, numbered after those before it."""
        return self.add_network(replace(SimNetwork(name, len(self.networks) + 1), **values))  # type: ignore[arg-type]

    def add(
        self,
        settings: Settings,
        networks: Iterable[str],
        *,
        store: Store | None = None,
        log_store: LogStore | None = None,
        background: Background = in_foreground,
    ) -> Endpoint:
        """Start (or restart) a node with a link, named like the network, on each of these networks."""
        name = settings.name
        node = Endpoint(
            settings,
            boot_id=self.rng.randbytes(16),
            rng=self.rng,
            now=self.clock(name),
            store=store,
            log_store=log_store,
            background=background,
        )
        self.nodes[name] = node
        self.events.setdefault(name, [])
        self._wakes_at[name] = float("inf")
        for network in networks:
            self.connect(name, network)
        self.pump(name)
        return node

    def connect(self, name: str, network: str) -> None:
        """Give a node a link on this network."""
        on = self.networks[network]
        if name not in on.members:
            on.members.append(name)
        link = LinkInfo(network, LinkKind.BROADCAST, on.address(name), on.broadcast, on.mtu)
        self.nodes[name].link_up(link, self.clock(name))

    def stop(self, name: str) -> None:
        """The node dies without a word."""
        del self.nodes[name]

    def suspend(self, name: str) -> Endpoint:
        """The node's process stops; what is sent to it meanwhile is lost."""
        return self.nodes.pop(name)

    def wake(self, name: str) -> None:
        """The node does what is due."""
        if name in self.nodes:
            self.nodes[name].handle_timer(self.clock(name))
            self.pump(name)

    def resume(self, node: Endpoint) -> None:
        """A suspended process continues."""
        name = node.settings.name
        self.nodes[name] = node
        self._wakes_at[name] = self.now
        self._wake(name, node, self.now)

    def send(self, name: str, topic: str, payload: bytes, destination: str | None = None) -> MessageId | Rejected:
        outcome = self.nodes[name].send(topic, payload, destination=destination, now=self.clock(name))
        self.pump(name)
        return outcome

    def conditions(self, name: str) -> Conditions:
        return self.nodes[name].conditions(self.clock(name))

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Advance virtual time; stops early, and returns True, once `until` holds."""
        end = self.now + seconds
        while until is None or not until():
            if not self.event_queue.step(end):
                return until is not None and until()
        return True

    def pump(self, name: str) -> None:
        """Do what a driver does after it called a node: send its datagrams, fetch its events, set its timer."""
        node = self.nodes.get(name)
        if node is None:
            return
        while datagrams := node.datagrams_to_send(self.clock(name)):
            for datagram in datagrams:
                self._transmit(name, datagram)
        while (event := node.next_event()) is not None:
            self.events[name].append((self.now, event))
            if self.on_event is not None:
                self.on_event(name, event, self.now)
        at = node.next_timer()
        if at is not None:
            at -= self.clocks.get(name, 0.0)
        if at is not None and max(at, self.now) < self._wakes_at[name]:
            at = max(at, self.now + _MIN_STEP_S)
            if self.timers_late_s:
                at = min(self._wakes_at[name], at + self.rng.random() * self.timers_late_s)
            self._wakes_at[name] = at
            self.event_queue.at(at, lambda: self._wake(name, node, at))

    def _wake(self, name: str, node: Endpoint, at: float) -> None:
        if self.nodes.get(name) is not node or self._wakes_at[name] != at:
            return
        self._wakes_at[name] = float("inf")
        node.handle_timer(self.clock(name))
        self.pump(name)

    def _transmit(self, name: str, datagram: Datagram) -> None:
        network = self.networks[datagram.link]
        if self.on_datagram is not None:
            self.on_datagram(name, network.name, datagram, self.now)
        size = len(datagram.data) + IP_UDP_BYTES
        busy_until = max(self.now, self._busy_until.get((network.name, name), 0.0))
        backlog = (busy_until - self.now) * network.rate_bits_per_s / 8 / 1500
        if not network.up or backlog >= network.queue_packets or size > network.mtu:
            network.dropped += 1
            return
        sent_at = busy_until + size * 8 / network.rate_bits_per_s
        self._busy_until[network.name, name] = sent_at
        network.carried_bytes += size
        source = network.address(name)
        for member in network.members:
            to_it = datagram.destination in (None, network.broadcast, network.address(member))
            if member == name or not to_it:
                continue
            if self.rng.random() < network.losses.get((name, member), network.loss):
                continue
            arrives_at = sent_at + network.delay_s
            if network.jitter_s:
                arrives_at += self.rng.random() * network.jitter_s
            arrive = partial(self._arrive, member, network, datagram.data, source)
            self.event_queue.at(arrives_at, arrive)
            if network.duplicates and self.rng.random() < network.duplicates:
                self.event_queue.at(arrives_at + self.rng.random() * network.jitter_s, arrive)

    def _arrive(self, name: str, network: SimNetwork, data: bytes, source: Address) -> None:
        node = self.nodes.get(name)
        if node is not None and network.up:
            node.receive(data, network.name, source, self.clock(name))
            self.pump(name)
