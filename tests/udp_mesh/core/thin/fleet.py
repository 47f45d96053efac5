"""Nodes on one thin link in virtual time, with or without a network of datagrams beside it."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event, MessageId, MessageReceived, Rejected
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import LinkInfo, LinkKind, Settings, Topic
from udp_mesh.core.thin.conditions import ThinConditions, ThinPeerConditions
from udp_mesh.core.thin.settings import ThinLinkSettings, ThinSettings
from udp_mesh.core.thin.thin_links import ThinLinks
from udp_mesh.crypto import Key
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.thin_medium import ThinMedium

KEY = Key(bytes(range(32)))
ESTOP = Topic("estop", priority=0, thin=True)
REPORT = Topic("report", priority=8, thin=True, deadline_s=600.0)
POSITION = Topic("position", priority=13, reliable=False, keep_last=1, thin=True, thin_period_s=30.0)
TOPICS = (ESTOP, REPORT, POSITION, Topic("map", priority=9))
RADIO = ThinLinkSettings("radio", bits_per_s=10_000, frame_bytes=64)
WIFI, WIFI_DELAY_S = "mesh0", 0.002


def settings(name: str, number: int, link: ThinLinkSettings = RADIO, **changes: object) -> Settings:
    """A node with these topics on this thin link."""
    base = Settings(name, keys=(KEY,), topics=TOPICS, thin=ThinSettings(number, (link,), presence_s=20.0))
    return replace(base, **changes)  # type: ignore[arg-type]


class ThinFleet:
    """`loss` is the thin link's; `wifi` has the nodes between which datagrams pass. `on_frame` may drop or replace a
    frame before it is on the air (None: lost), and `frames` records all."""

    def __init__(
        self,
        *names: str,
        link: ThinLinkSettings = RADIO,
        loss: float = 0.0,
        seed: int = 1,
        timers_late_s: float = 0.0,
        **changes: object,
    ) -> None:
        """Timers come up to `timers_late_s` late, as on busy computers."""
        self.event_queue = SimEventQueue()
        self.rng = random.Random(seed)
        self.loss = loss
        self.timers_late_s = timers_late_s
        self.apart: set[str] = set()
        """Nodes out of the thin link's range."""
        self.wifi: set[str] = set()
        self.link = link
        self.nodes: dict[str, Endpoint] = {}
        self.events: dict[str, list[tuple[float, Event]]] = {name: [] for name in names}
        self.frames: list[tuple[str, bytes]] = []
        self.on_frame: Callable[[str, bytes], bytes | None] = lambda name, frame: frame
        self._names = list(names)
        self._changes = changes
        self._wakes_at: dict[str, float] = {}
        self._past_timers: Counter[str] = Counter()
        self.medium = ThinMedium(self.event_queue, link, names, self._loss, self._arrive, self.rng)
        for name in names:
            self.start(name)

    @property
    def now(self) -> float:
        return self.event_queue.now

    def _loss(self, a: str, b: str, _: float) -> float:
        return 1.0 if self.apart & {a, b} else self.loss

    def settings(self, name: str) -> Settings:
        return settings(name, self._names.index(name) + 1, self.link, **self._changes)

    def start(self, name: str) -> Endpoint:
        """Start, or restart, a node."""
        node = Endpoint(self.settings(name), boot_id=self.rng.randbytes(16), rng=self.rng, now=self.now)
        number = self._names.index(name) + 1
        address = (f"10.0.0.{number}", 8700)
        node.link_up(LinkInfo(WIFI, LinkKind.BROADCAST, address, ("10.0.0.255", 8700)), self.now)
        self.nodes[name] = node
        self._wakes_at[name] = float("inf")
        self.pump(name)
        return node

    def thin(self, name: str) -> ThinLinks:
        found = self.nodes[name].thin
        assert found is not None
        return found

    def conditions(self, name: str) -> ThinConditions:
        return self.thin(name).conditions(self.now)

    def peer(self, at: str, name: str) -> ThinPeerConditions | None:
        return next((peer for peer in self.conditions(at).peers if peer.name == name), None)

    def met(self) -> bool:
        """Whether every node knows that it is heard by every other one in range."""
        inside = [name for name in self.nodes if name not in self.apart]
        return all(len(self.thin(name).peers.present(self.now)) == len(inside) - 1 for name in inside)

    def send(self, name: str, topic: str, payload: bytes, destination: str | None = None) -> MessageId | Rejected:
        outcome = self.nodes[name].send(topic, payload, destination=destination, now=self.now, type_name="t")
        self.pump(name)
        return outcome

    def received(self, name: str, topic: str | None = None) -> list[bytes]:
        """Payloads in the order in which they arrived."""
        events = [event for _, event in self.events[name] if isinstance(event, MessageReceived)]
        return [event.payload for event in events if topic in (None, event.topic)]

    def reported(self, name: str, kind: type[Event]) -> list[Event]:
        return [event for _, event in self.events[name] if isinstance(event, kind)]

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        end = self.now + seconds
        while until is None or not until():
            if not self.event_queue.step(end):
                return until is not None and until()
        return True

    def pump(self, name: str) -> None:
        node = self.nodes[name]
        while datagrams := node.datagrams_to_send(self.now):
            for datagram in datagrams:
                self._transmit(name, datagram)
        while (event := node.next_event()) is not None:
            self.events[name].append((self.now, event))
        at = node.next_timer()
        if at is not None and at < self._wakes_at[name]:
            late_s = self.rng.random() * self.timers_late_s if self.timers_late_s else 0.0
            self._wakes_at[name] = at = min(self._wakes_at[name], max(at, self.now + 1e-6) + late_s)
            self.event_queue.at(at, partial(self._wake, name, node, at))

    def _wake(self, name: str, node: Endpoint, at: float) -> None:
        if self.nodes.get(name) is node and self._wakes_at[name] == at:
            self._wakes_at[name] = float("inf")
            node.handle_timer(self.now)
            self.pump(name)
            due = node.next_timer()
            in_the_past = due is not None and due <= self.now
            self._past_timers[name] = self._past_timers[name] + 1 if in_the_past else 0
            assert self._past_timers[name] < 4, f"{name} runs in circles: its next timer stays in the past"

    def _transmit(self, name: str, datagram: Datagram) -> None:
        if datagram.link == WIFI:
            source = (f"10.0.0.{self._names.index(name) + 1}", 8700)
            for number, other in enumerate(self._names, 1):
                to = datagram.destination
                addressed = to is None or to[0] in ("10.0.0.255", f"10.0.0.{number}")
                if other != name and addressed and {name, other} <= self.wifi:
                    self.event_queue.after(WIFI_DELAY_S, partial(self._arrive_wifi, other, datagram.data, source))
            return
        self.frames.append((name, datagram.data))
        frame = self.on_frame(name, datagram.data)
        if frame is not None:
            self.medium.send(name, frame)

    def _arrive_wifi(self, name: str, data: bytes, source: tuple[str, int]) -> None:
        self.nodes[name].receive(data, WIFI, source, self.now)
        self.pump(name)

    def _arrive(self, name: str, frame: bytes) -> None:
        node = self.nodes.get(name)
        if node is not None:
            node.receive(frame, self.link.name, ("", 0), self.now)
            self.pump(name)
