"""A relay without the key: it forwards everything both sides send, from an address of its own."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerAddressChanged, PeerOffline, PeerOnline
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.receiver.copies import COPY_INTERVAL_S
from udp_mesh.core.settings import Topic
from udp_mesh.crypto import ReceiveChannel

RELAY = ("10.0.0.66", 8700)
POSE = Topic("pose", priority=5)


class RelayedWorld(World):
    """`a` and `b`, and a relay that forwards each datagram of one of them to the other while `is_relaying`."""

    def __init__(self, delay_s: float) -> None:
        super().__init__(seed=5)
        self.delay_s = delay_s
        self.is_relaying = True
        self.tap = self._relay
        for name in "ab":
            self.add(settings(name, POSE))

    def _relay(self, source: str, datagram: Datagram, now: float) -> None:
        if self.is_relaying:
            target = "b" if source == "a" else "a"
            self.at(now + self.delay_s, lambda: self.nodes[target].receive(datagram.data, "mesh", RELAY, self.now))

    def direct(self, up: bool) -> None:
        for pipe in self.pipes.values():
            pipe.up = up

    def path(self, of: str, at: str) -> tuple[str, int] | None:
        return next(peer.address for peer in self.nodes[at].conditions(self.now).peers if peer.name == of)


def payloads(world: World) -> list[bytes]:
    return [event.payload for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]


def test_a_relay_is_the_path_while_the_direct_one_does_not_answer() -> None:
    world = RelayedWorld(delay_s=0.02)
    world.direct(up=False)
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    assert world.path("a", at="b") == world.path("b", at="a") == RELAY
    world.send("a", "pose", b"1", "b")
    assert world.run(5.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    assert len(world.events_of("b", MessageReceived)) == 1


@pytest.mark.parametrize("delay_s", [0.0001, 0.02])
def test_a_path_in_use_stays_in_use_beside_a_relay(delay_s: float) -> None:
    """Even if the relay is faster: all that comes over the path has come from the relay before."""
    world = RelayedWorld(delay_s)
    world.is_relaying = False
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    world.is_relaying = True
    for number in range(60):
        world.send("a", "pose", b"%d" % number, "b")
        world.run(1.0)
        assert world.path("a", at="b") == world.addresses["a"]
        assert world.path("b", at="a") == world.addresses["b"]
    assert payloads(world) == [b"%d" % number for number in range(60)]
    assert not any(world.events_of(name, PeerAddressChanged) for name in "ab")


def test_an_idle_path_stays_in_use_beside_a_relay() -> None:
    """Heartbeats alone keep it."""
    world = RelayedWorld(delay_s=0.0001)
    world.is_relaying = False
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    world.is_relaying = True
    world.run(120.0)
    assert world.path("a", at="b") == world.addresses["a"]
    assert not any(world.events_of(name, PeerAddressChanged) for name in "ab")


@pytest.mark.parametrize("delay_s", [0.0001, 0.02])
def test_a_flood_of_copies_is_rarely_opened(delay_s: float, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[bytes] = []
    open_copy = ReceiveChannel.open_copy

    def counted(channel: ReceiveChannel, data: bytes) -> bytes:
        opened.append(data)
        return open_copy(channel, data)

    monkeypatch.setattr(ReceiveChannel, "open_copy", counted)
    world = RelayedWorld(delay_s)
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    recorded: list[bytes] = []
    world.tap = lambda name, datagram, now: recorded.append(datagram.data) if name == "a" else None
    world.run(2.0)
    world.tap = None
    opened.clear()
    for _ in range(1000):
        for data in recorded:
            world.nodes["b"].receive(data, "mesh", RELAY, world.now)
        world.run(0.001)
    assert 0 < len(opened) <= 2 * 1.0 / COPY_INTERVAL_S


def test_the_peers_own_path_replaces_a_relay_that_stops_forwarding() -> None:
    world = RelayedWorld(delay_s=0.02)
    world.direct(up=False)
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    world.send("a", "pose", b"1", "b")
    world.is_relaying = False
    world.direct(up=True)
    assert world.run(30.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    world.run(60.0)
    assert len(world.events_of("b", MessageReceived)) == 1
    assert world.path("a", at="b") == world.addresses["a"]
    assert world.path("b", at="a") == world.addresses["b"]
    assert not world.events_of("a", PeerOffline)
