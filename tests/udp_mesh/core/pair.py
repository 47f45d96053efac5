"""Nodes in memory under a virtual clock: complete sessions as transcripts, lossy links as deterministic models.

`pair()` makes two nodes that have met. `roundtrip()` delivers everything both ways at once; `drop()` loses what a node
would send. `World` runs any number of nodes over modeled links (`Pipe`: rate, delay, finite queue, loss) in virtual
time.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event
from udp_mesh.core.interfaces import Datagram, Store
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.settings import Address, LinkInfo, LinkKind, Settings, Topic
from udp_mesh.crypto import Key

KEY = Key(bytes(range(32)))
BROADCAST = ("10.0.0.255", 8700)
IP_UDP_BYTES = 28


def settings(name: str, *topics: Topic, **changes: object) -> Settings:
    """Settings with the test key and any topic allowed."""
    base = Settings(name=name, keys=(KEY,), topics=topics, undeclared=Topic("any"))
    return replace(base, **changes)  # type: ignore[arg-type]


@dataclass
class Pipe:
    """One direction between two nodes: loss, then a finite queue drained at a rate, then a delay."""

    rate_bits_per_s: float = 10e6
    delay_s: float = 0.010
    queue_packets: int = 100
    loss: float = 0.0
    lost: Callable[[random.Random, float], bool] | None = None
    """A custom loss model instead of `loss`."""
    up: bool = True
    carried_bytes: int = 0
    carried: int = 0
    dropped: int = 0
    _busy_until: float = 0.0
    _leaving: list[float] = field(default_factory=list)

    def carry(self, size_bytes: int, now: float, rng: random.Random) -> float | None:
        """When the datagram arrives, or None if it is lost. `size_bytes` is the UDP payload."""
        self.carried += 1
        self.carried_bytes += size_bytes + IP_UDP_BYTES
        self._leaving = [at for at in self._leaving if at > now]
        if not self.up or len(self._leaving) >= self.queue_packets:
            self.dropped += 1
            return None
        start = max(now, self._busy_until)
        self._busy_until = start + (size_bytes + IP_UDP_BYTES) * 8 / self.rate_bits_per_s
        self._leaving.append(self._busy_until)
        if self.lost(rng, now) if self.lost is not None else rng.random() < self.loss:
            self.dropped += 1
            return None
        return self._busy_until + self.delay_s


class World:
    """Nodes by name, pipes by (from, to); everything happens in virtual time, in a fixed order for a seed."""

    def __init__(self, seed: int = 1, start: float = 1000.0) -> None:
        self.now = start
        self.rng = random.Random(seed)
        self.nodes: dict[str, Endpoint] = {}
        self.addresses: dict[str, Address] = {}
        self.pipes: dict[tuple[str, str], Pipe] = {}
        self.events: dict[str, list[tuple[float, Event]]] = {}
        self.on_event: Callable[[str, Event, float], None] | None = None
        self.tap: Callable[[str, Datagram, float], None] | None = None
        self._queue: list[tuple[float, int, str, str, bytes]] = []
        self._calls: list[tuple[float, int, Callable[[], object]]] = []
        self._serial = 0

    def add(
        self,
        config: Settings,
        *,
        address: str | None = None,
        store: Store | None = None,
        log_store: LogStore | None = None,
    ) -> Endpoint:
        """Start (or restart) a node on link `mesh`."""
        name = config.name
        boot_id = self.rng.randbytes(16)
        node = Endpoint(config, boot_id=boot_id, rng=self.rng, now=self.now, store=store, log_store=log_store)
        host = address or (self.addresses[name][0] if name in self.addresses else f"10.0.0.{len(self.addresses) + 1}")
        self.addresses[name] = (host, 8700)
        self.nodes[name] = node
        self.events.setdefault(name, [])
        node.link_up(LinkInfo("mesh", LinkKind.BROADCAST, (host, 8700), BROADCAST), self.now)
        for other in self.nodes:
            if other != name:
                self.pipes.setdefault((name, other), Pipe())
                self.pipes.setdefault((other, name), Pipe())
        return node

    def at(self, when: float, call: Callable[[], object]) -> None:
        """Call a function at a virtual time."""
        self._serial += 1
        heapq.heappush(self._calls, (when, self._serial, call))

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Advance virtual time; stops early, and returns True, once `until` holds."""
        end = self.now + seconds
        for name in list(self.nodes):
            self._pump(name)
        while True:
            if until is not None and until():
                return True
            timers = [(at, name) for name, node in self.nodes.items() if (at := node.next_timer()) is not None]
            times = [entry[0] for entry in (self._queue[:1] + self._calls[:1])] + [at for at, _ in timers]
            at = max(self.now, min(times, default=end))
            if at > end:
                self.now = end
                return until is not None and until()
            self.now = at
            touched: dict[str, None] = {}
            while self._queue and self._queue[0][0] <= at:
                _, _, source, target, data = heapq.heappop(self._queue)
                if target in self.nodes:
                    self.nodes[target].receive(data, "mesh", self.addresses[source], at)
                    touched[target] = None
            while self._calls and self._calls[0][0] <= at:
                heapq.heappop(self._calls)[2]()
                touched.update(dict.fromkeys(self.nodes))
            for due, name in timers:
                if due <= at and name in self.nodes:
                    self.nodes[name].handle_timer(at)
                    touched[name] = None
            for name in touched:
                self._pump(name)

    def send(self, source: str, topic: str, payload: bytes, destination: str | None = None) -> object:
        """Call `Endpoint.send` and transmit."""
        result = self.nodes[source].send(topic, payload, destination=destination, now=self.now)
        self._pump(source)
        return result

    def events_of(self, name: str, kind: type) -> list[Event]:
        """A node's events of one kind so far."""
        self._fetch(name)
        return [event for _, event in self.events[name] if isinstance(event, kind)]

    def _fetch(self, name: str) -> None:
        node = self.nodes[name]
        while (event := node.next_event()) is not None:
            self.events[name].append((self.now, event))
            if self.on_event is not None:
                self.on_event(name, event, self.now)

    def _pump(self, name: str) -> None:
        node = self.nodes.get(name)
        if node is None:
            return
        while datagrams := node.datagrams_to_send(self.now):
            for datagram in datagrams:
                if self.tap is not None:
                    self.tap(name, datagram, self.now)
                for target in list(self.nodes):
                    if target == name or datagram.destination not in (None, BROADCAST, self.addresses[target]):
                        continue
                    arrives = self.pipes[(name, target)].carry(len(datagram.data), self.now, self.rng)
                    if arrives is not None:
                        self._serial += 1
                        heapq.heappush(self._queue, (arrives, self._serial, name, target, datagram.data))
        self._fetch(name)


class Pair:
    """Two nodes, `a` and `b`, and a manual clock."""

    def __init__(self, a: Settings, b: Settings) -> None:
        self.now = 1000.0
        self.rng = random.Random(7)
        self.a = Endpoint(a, boot_id=self.rng.randbytes(16), rng=self.rng, now=self.now)
        self.b = Endpoint(b, boot_id=self.rng.randbytes(16), rng=self.rng, now=self.now)
        self.a.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.1", 8700), BROADCAST), self.now)
        self.b.link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.2", 8700), BROADCAST), self.now)

    def leave(self, node: Endpoint) -> list[Datagram]:
        """Everything that a node sends now."""
        node.handle_timer(self.now)
        out = []
        while datagrams := node.datagrams_to_send(self.now):
            out.extend(datagrams)
        return out

    def roundtrip(self, times: int = 1, step_s: float = 0.01) -> int:
        """Deliver everything both ways, then advance by `step_s`; returns the number of datagrams."""
        carried = 0
        for _ in range(times):
            to_b, to_a = self.leave(self.a), self.leave(self.b)
            for datagram in to_b:
                self.b.receive(datagram.data, "mesh", ("10.0.0.1", 8700), self.now)
            for datagram in to_a:
                self.a.receive(datagram.data, "mesh", ("10.0.0.2", 8700), self.now)
            carried += len(to_a) + len(to_b)
            self.now += step_s
        return carried

    def drop(self, node: Endpoint) -> list[Datagram]:
        """Lose what a node sends now; returned for inspection or a later replay."""
        return self.leave(node)

    def events(self, node: Endpoint) -> list[Event]:
        """A node's events since the last call."""
        events = []
        while (event := node.next_event()) is not None:
            events.append(event)
        return events


def pair(*topics: Topic, **changes: object) -> Pair:
    """Two nodes that have met; the events of that are already fetched."""
    both = Pair(settings("a", *topics, **changes), settings("b", *topics, **changes))
    both.roundtrip(times=60)
    both.events(both.a)
    both.events(both.b)
    return both
