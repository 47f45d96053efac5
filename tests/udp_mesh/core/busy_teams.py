"""Random teams on busy computers: `python -m tests.udp_mesh.core.promises 0 2000 --busy`.

Computers stop for up to 30 s, and then do everything at once: their timers come late, and datagrams are read in bursts,
some with arrival times that are wrong because the wall clock was set. Some teams have a robot with the legacy program,
some a thin link. What `promises` checks holds nevertheless.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from tests.udp_mesh.core.legacy_node import TO_ALL, TYPE, LegacyNode
from tests.udp_mesh.core.random_teams import SMALL, TOPICS, Broken, RandomTeam, key_of
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import Address, Neighbour, Settings, Topic
from udp_mesh.core.thin.settings import ThinLinkSettings, ThinSettings
from udp_mesh.daemon.driver import MAX_DRAIN_DATAGRAMS
from udp_mesh.sim.thin_medium import ThinMedium
from udp_mesh.sim.topology import SimNetwork
from udp_mesh.wire.legacy import PriorityMeshData

OLD = "old"
LEGACY_TOPICS = ("status", "map")
LEGACY_TURN_S = 0.01
RADIO = ThinLinkSettings("radio", bits_per_s=10_000, frame_bytes=64, duty_cycle=0.2, window_s=60.0)
THIN_TOPICS = (
    Topic("alarm", priority=0, thin=True),
    Topic("report", priority=8, thin=True, deadline_s=60.0),
    Topic("position", priority=13, reliable=False, keep_last=1, thin=True, thin_period_s=5.0),
)
MAX_WAITING_DATAGRAMS = 300
"""Of a socket; those that come then are lost."""
BUSY_S = (0.001, 0.02, 0.02, 0.3, 2.0, 12.0, 30.0)


class Waiting(NamedTuple):
    """A datagram in a socket of a busy computer."""

    data: bytes
    link: str
    source: Address
    arrived_at: float


class BusyTeam(RandomTeam):
    """A team that follows from its seed."""

    topics: tuple[Topic, ...] = (*TOPICS, *THIN_TOPICS)

    def __init__(self, seed: int) -> None:
        self.has_legacy, self.has_radio = seed % 2 == 0, seed // 2 % 2 == 0
        if not self.has_radio:
            self.topics = TOPICS
        self.legacy: LegacyNode | None = None
        self.medium: ThinMedium | None = None
        self.radio_loss = 0.0
        self._arrived_at: float | None = None
        self._waiting: dict[str, deque[Waiting]] = {}
        """In the sockets of computers that are busy."""
        super().__init__(seed)
        self.timers_late_s = (0.0, 0.001, 0.05, 0.3)[seed // 4 % 4]

    # The team

    def add_network(self, network: SimNetwork) -> SimNetwork:
        first = not self.networks
        super().add_network(network)
        if first and self.has_legacy:
            network.members.append(OLD)
            self.arrived[OLD], self.confirmed[OLD] = set(), set()
            self.runs[OLD] = 1
            self.legacy = LegacyNode(
                OLD, network.address(OLD)[0], network.broadcast[0], self._transmit_legacy, self._on_legacy_message
            )
            self.event_queue.after(0.0, self._turn_legacy)
        return network

    def equipped(self, place: int, settings: Settings) -> Settings:
        first = next(iter(self.networks.values()))
        if self.has_legacy and first.name in self.homes[settings.name]:
            neighbour = Neighbour(first.address(OLD), name=OLD, link=first.name, legacy=True)
            settings = replace(settings, neighbours=(neighbour,))
        if self.has_radio:
            settings = replace(settings, thin=ThinSettings(place + 1, (RADIO,), presence_s=5.0))
            if self.medium is None:
                self.medium = ThinMedium(
                    self.event_queue, RADIO, "abcd", lambda *_: self.radio_loss, self._arrive_by_radio, self.rng
                )
        return settings

    def _transmit(self, name: str, datagram: Datagram) -> None:
        if datagram.link == RADIO.name:
            assert self.medium is not None
            self.medium.send(name, datagram.data)
        else:
            super()._transmit(name, datagram)

    # The legacy program

    def _transmit_legacy(self, data: bytes, host: str) -> None:
        network = next(iter(self.networks.values()))
        self._transmit(OLD, Datagram(network.name, (host, network.broadcast[1]), data, False))

    def _on_legacy_message(self, source: str, message: PriorityMeshData) -> None:
        key = key_of(message.data)
        self.arrived[OLD].add(key)
        self.confirmed[OLD].add(key)

    def _turn_legacy(self) -> None:
        assert self.legacy is not None
        if OLD not in self._waiting:
            self.legacy.begin_turn(None, self.now)
            self.legacy.end_turn(None, self.now)
        self.event_queue.after(LEGACY_TURN_S if self.legacy.broadcasts else 0.2, self._turn_legacy)

    def publish(self, source: str, topic: Topic, target: str | None) -> None:
        if source in self._waiting:
            return
        if self.legacy is not None and self.dice.random() < 0.1 and OLD not in self._waiting:
            self.serial += 1
            payload = b"old 1 %d|" % self.serial + bytes(self.dice.choice((*SMALL, 9_000)))
            to = TO_ALL if target is None else target
            message = PriorityMeshData(to, TYPE, 5, self.dice.choice(LEGACY_TOPICS), payload)
            self.legacy.begin_turn(message, self.now)
            self.legacy.end_turn(None, self.now)
        if target is not None and self.config[source].neighbours and self.dice.random() < 0.3:
            target = OLD
        super().publish(source, topic, target)

    # Busy computers

    @property
    def arrived_at(self) -> float:
        return self.now if self._arrived_at is None else self._arrived_at

    def change(self) -> None:
        """One random change, half of them of how busy a computer is."""
        if self.dice.random() < 0.5:
            super().change()
            return
        self.radio_loss = self.dice.choice((0.0, 0.1, 0.5, 1.0))
        name = self.dice.choice([*self.homes, *([OLD] if self.legacy is not None else [])])
        if name not in self._waiting and (name == OLD or name in self.nodes):
            self._waiting[name] = deque()
            self.event_queue.after(self.dice.choice(BUSY_S), partial(self._catch_up, name, self.nodes.get(name)))

    def start(self, name: str) -> None:
        self._waiting.pop(name, None)
        super().start(name)

    def kill(self, name: str, *, politely: bool = False) -> None:
        # a daemon that is asked to end does so once its computer lets it run
        if politely and name in self._waiting:
            self._catch_up(name, self.nodes[name])
        super().kill(name, politely=politely)

    def pump(self, name: str) -> None:
        if name not in self._waiting:
            super().pump(name)

    def wake(self, name: str) -> None:
        if name not in self._waiting:
            super().wake(name)

    def _wake(self, name: str, node: Endpoint, at: float) -> None:
        if name not in self._waiting:
            super()._wake(name, node, at)

    def _arrive(self, name: str, network: SimNetwork, data: bytes, source: Address) -> None:
        if network.up:
            self._arrive_now(name, Waiting(data, network.name, source, self.now))

    def _arrive_by_radio(self, name: str, frame: bytes) -> None:
        self._arrive_now(name, Waiting(frame, RADIO.name, ("", 0), self.now))

    def _arrive_now(self, name: str, datagram: Waiting) -> None:
        waiting = self._waiting.get(name)
        if waiting is None:
            self._receive(name, datagram, self.clock(name))
            self.pump(name)
        elif len(waiting) < MAX_WAITING_DATAGRAMS:
            waiting.append(datagram)

    def _receive(self, name: str, datagram: Waiting, now: float) -> None:
        if name == OLD:
            assert self.legacy is not None
            self.legacy.begin_turn(None, now)
            self.legacy.end_turn((datagram.data, datagram.source[0]), now)
            return
        node = self.nodes.get(name)
        if node is not None:
            self._arrived_at = datagram.arrived_at
            node.receive(datagram.data, datagram.link, datagram.source, now)
            self._arrived_at = None

    def _catch_up(self, name: str, node: Endpoint | None) -> None:
        """A computer is no longer busy: a driver reads what waits in batches, each with the times of arrival, and then
        handles timers."""
        if self.nodes.get(name) is not node or name not in self._waiting:
            return
        waiting = self._waiting.pop(name)
        # Of the kernel; after the wall clock was set they are wrong, and limited by the driver.
        shift_s = self.dice.choice((0.0, 0.0, 0.0, 0.5, -0.3, float("inf")))
        now = 0.0
        while waiting:
            for _ in range(min(len(waiting), MAX_DRAIN_DATAGRAMS)):
                datagram = waiting.popleft()
                at = min(datagram.arrived_at + shift_s, self.now)
                # the legacy program takes its own time, when it reads
                now = max(now, self.now if name == OLD else at)
                self._receive(name, datagram, self.clocks.get(name, 0.0) + now)
            if node is not None:
                self._do_what_is_due(name, node)
        if node is not None:
            self._do_what_is_due(name, node)

    def _do_what_is_due(self, name: str, node: Endpoint) -> None:
        self._wakes_at[name] = float("inf")
        node.handle_timer(self.clock(name))
        self.pump(name)
        self.check_timer(name, node)

    def repair(self) -> None:
        """No computer is busy any more."""
        self.radio_loss, self.timers_late_s = 0.0, min(self.timers_late_s, 0.05)
        for name in list(self._waiting):
            if name in self.suspended:
                del self._waiting[name]
            else:
                self._catch_up(name, self.nodes.get(name))
        super().repair()
        if self._waiting:
            raise Broken(f"{self._waiting.keys()} are still busy")
