"""Cores of the transport on paths: every input to a node is followed by its datagrams, its events and its next timer.

`connect` gives two nodes a path in each direction; a broadcast takes every path of its node.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.sender.path import IP_UDP_BYTES
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.path import Carrier

LINK = "mesh0"
BROADCAST = "10.0.0.255"
_MIN_STEP_S = 1e-6

OnEvent = Callable[[float, str, Event], None]
"""(now, node, event of the node)."""


@dataclass(slots=True)
class _Attached:
    name: str
    address: tuple[str, int]
    node: Endpoint
    paths: dict[str, Carrier] = field(default_factory=dict)
    """By the address of the node that they lead to."""
    wakes_at_s: float = float("inf")


class Network:
    """Nodes by name, started at once; nothing is carried before `connect`."""

    def __init__(
        self, event_queue: SimEventQueue, settings: list[Settings], *, seed: int, on_event: OnEvent | None = None
    ) -> None:
        self._event_queue = event_queue
        self._on_event = on_event or (lambda now, name, event: None)
        self._members: dict[str, _Attached] = {}
        self._by_address: dict[str, _Attached] = {}
        self.datagrams_sent = dict.fromkeys((member.name for member in settings), 0)
        self.bytes_sent = dict(self.datagrams_sent)
        """IP packets, by sending node."""
        rng = random.Random(f"network {seed}")
        for number, link in enumerate(settings, 1):
            address = (f"10.0.0.{number}", link.port)
            node = Endpoint(link, boot_id=rng.randbytes(16), rng=random.Random(rng.random()), now=event_queue.now)
            node.link_up(LinkInfo(LINK, LinkKind.BROADCAST, address, (BROADCAST, link.port)), event_queue.now)
            self._members[link.name] = self._by_address[address[0]] = _Attached(link.name, address, node)

    def connect(self, source: str, target: str, path: Carrier) -> None:
        """Datagrams from `source` to `target` take this path from now on."""
        self._members[source].paths[self._members[target].address[0]] = path

    def start(self) -> None:
        for member in self._members.values():
            self.pump(member.name)

    def node(self, name: str) -> Endpoint:
        return self._members[name].node

    def send(self, source: str, topic: str, payload: bytes, target: str) -> None:
        """Send a message; one that is refused is an error of the caller's load."""
        member = self._members[source]
        result = member.node.send(topic, payload, destination=target, now=self._event_queue.now)
        if not isinstance(result, int):
            raise ValueError(f"{source} refused a message of {topic}: {result}")

    def pump(self, name: str) -> None:
        """Carry what the node sends now, hand out its events and schedule its next timer."""
        member = self._members[name]
        node, now = member.node, self._event_queue.now
        while datagrams := node.datagrams_to_send(now):
            for datagram in datagrams:
                self._carry(member, datagram)
        while (event := node.next_event()) is not None:
            self._on_event(now, name, event)
        timer_s = node.next_timer()
        if timer_s is not None and timer_s < member.wakes_at_s:
            member.wakes_at_s = max(timer_s, now + _MIN_STEP_S)
            self._event_queue.at(member.wakes_at_s, partial(self._wake, member))

    def _carry(self, source: _Attached, datagram: Datagram) -> None:
        size_bytes = len(datagram.data) + IP_UDP_BYTES
        destination = datagram.destination
        to_all = destination is None or destination[0] == BROADCAST
        for address, path in source.paths.items():
            if to_all or (destination is not None and destination[0] == address):
                self.datagrams_sent[source.name] += 1
                self.bytes_sent[source.name] += size_bytes
                target = self._by_address[address]
                path.send(size_bytes, partial(self._deliver, source.address, target, datagram.data))

    def _deliver(self, source: tuple[str, int], target: _Attached, data: bytes) -> None:
        target.node.receive(data, LINK, source, self._event_queue.now)
        self.pump(target.name)

    def _wake(self, member: _Attached) -> None:
        if self._event_queue.now < member.wakes_at_s:
            return
        member.wakes_at_s = float("inf")
        member.node.handle_timer(self._event_queue.now)
        self.pump(member.name)
