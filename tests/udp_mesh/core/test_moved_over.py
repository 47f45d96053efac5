"""A fleet is upgraded robot by robot: nodes that take an upgraded robot for a legacy one detect the upgrade."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerOffline, PeerOnline
from udp_mesh.core.settings import Neighbour, Topic
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import Host, LegacyAck, LegacyPayload, decode_legacy, encode_legacy

OLD = ("10.0.0.2", 8700)
FIELDED = Neighbour(OLD, name="b", legacy=True)
MAP = bytes(range(256)) * 200


class Move:
    """`a` and `c` run our format and take `b` for a legacy robot, which it is: a program that answers like the legacy
    one."""

    def __init__(self) -> None:
        self.world = world = World(seed=4)
        self.payloads = 0
        self.answers = True
        world.add(settings("a", Topic("map", priority=7), neighbours=(FIELDED,)), address="10.0.0.1")
        world.add(settings("c", neighbours=(FIELDED,)), address="10.0.0.3")
        world.tap = lambda name, datagram, now: self._take(name, datagram.destination, bytes(datagram.data))
        for turn in range(8):
            world.at(world.now + turn, self._announce)
        assert world.run(3.0, until=lambda: len(world.events_of("a", PeerOnline)) == 2)

    def _announce(self) -> None:
        for node in self.world.nodes.values() if self.answers else ():
            node.receive(encode_legacy(Host("b", OLD[0])), "mesh", OLD, self.world.now)

    def _take(self, name: str, destination: object, data: bytes) -> None:
        if destination != OLD or not self.answers:
            return
        datagram = decode_legacy(data)
        if isinstance(datagram, LegacyPayload):
            self.payloads += 1
            ack = encode_legacy(LegacyAck(datagram.sequence, datagram.position))
            self.world.at(
                self.world.now + 0.005, lambda: self.world.nodes[name].receive(ack, "mesh", OLD, self.world.now)
            )

    def move(self) -> None:
        """The legacy program ends; our node starts in its place."""
        self.answers = False
        self.world.run(1.0)
        self.world.add(settings("b", Topic("map", priority=7)), address=OLD[0])

    def received(self, name: str) -> list[bytes]:
        return [
            event.payload for event in self.world.events_of(name, MessageReceived) if isinstance(event, MessageReceived)
        ]


def test_messages_continue_after_a_legacy_robot_was_upgraded_without_reconfiguration() -> None:
    move = Move()
    world = move.world
    world.send("a", "map", MAP, "b")
    assert world.run(5.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 1)
    assert move.payloads
    move.answers = False
    # These start in the old format and reach no receiver.
    world.send("a", "map", MAP, "b")
    world.send("a", "status", b"waits", "b")
    world.run(0.5)
    move.move()
    assert world.run(10.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 3)
    world.send("b", "map", MAP, "a")
    world.send("a", "map", MAP)
    assert world.run(10.0, until=lambda: len(move.received("a")) == 1 and len(move.received("b")) == 3)
    assert sorted(move.received("b"), key=len) == [b"waits", MAP, MAP]
    assert not world.nodes["a"].conditions(world.now).peers[0].legacy


def test_an_upgraded_robot_stays_online() -> None:
    move = Move()
    move.move()
    move.world.run(60.0)
    for name in ("a", "c"):
        assert move.world.events_of(name, PeerOffline) == []
    with_b = [peer for peer in move.world.nodes["a"].conditions(move.world.now).peers if peer.name == "b"]
    assert [(peer.online, peer.legacy) for peer in with_b] == [(True, False)]


def test_legacy_datagrams_from_an_upgraded_robot_are_dropped() -> None:
    move = Move()
    move.move()
    world = move.world
    world.run(5.0)
    seen: list[bytes] = []
    world.tap = lambda name, datagram, now: seen.append(bytes(datagram.data)) if datagram.destination == OLD else None
    before = world.nodes["a"].conditions(world.now).counters.dropped_unauthenticated
    world.nodes["a"].receive(encode_legacy(Host("b", OLD[0])), "mesh", OLD, world.now)
    assert world.nodes["a"].conditions(world.now).counters.dropped_unauthenticated == before + 1
    world.send("a", "status", b"x", "b")
    world.run(3.0)
    assert seen
    for data in seen:
        with pytest.raises(DecodeError):
            decode_legacy(data)
