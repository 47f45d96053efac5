"""Packing: small messages that are not urgent share datagrams in a stream, and lone ones never wait."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerOnline
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers import heartbeat
from udp_mesh.core.settings import Rates, Topic
from udp_mesh.wire.frames import Feature

POSE, URGENT, MAP = Topic("pose", priority=5), Topic("stop", priority=0), Topic("map", priority=5)
PACK_S = Rates().pack_s


class Recorded(World):
    """`a` and `b`, acquainted; `sent` has the datagrams of `a` since then and when each was sent."""

    def __init__(self, seed: int = 4) -> None:
        super().__init__(seed)
        for name in "ab":
            self.add(settings(name, POSE, URGENT, MAP))
        assert self.run(10.0, until=lambda: all(self.events_of(name, PeerOnline) for name in "ab"))
        for topic in (POSE, URGENT, MAP):
            self.send("a", topic.name, b"first", "b")
        self.run(1.0)
        self.sent: list[tuple[float, int]] = []
        self.tap = self._record
        self.began = self.now

    def _record(self, name: str, datagram: Datagram, now: float) -> None:
        if name == "a" and datagram.destination == self.addresses["b"]:
            self.sent.append((now - self.began, len(datagram.data)))

    def stream(self, topic: str, count: int, interval_s: float, size: int = 10) -> None:
        for number in range(count):
            self.at(self.now + number * interval_s, lambda: self.send("a", topic, bytes(size), "b"))


def test_a_stream_of_small_messages_shares_datagrams() -> None:
    world = Recorded()
    world.stream("pose", 2000, 0.0001)
    world.run(1.0)
    assert len(world.events_of("b", MessageReceived)) == 2003
    # 0.2 s of messages, a datagram every 3 ms
    assert len(world.sent) <= 0.2 / PACK_S * 1.2
    assert sum(size for _, size in world.sent) / 2000 < 26


def test_a_message_waits_no_longer_than_the_packing_time() -> None:
    world = Recorded()
    arrived: list[float] = []
    world.on_event = lambda name, event, now: arrived.append(now) if isinstance(event, MessageReceived) else None
    sent_at = [world.now + number * 0.0005 for number in range(400)]
    world.stream("pose", 400, 0.0005)
    world.run(1.0)
    delay_s = world.pipes["a", "b"].delay_s
    waited_s = [at - began - delay_s for at, began in zip(arrived, sent_at, strict=True)]
    assert max(waited_s) <= 2 * PACK_S
    assert sum(waited_s) / len(waited_s) <= PACK_S


@pytest.mark.parametrize("interval_s", [0.004, 0.05, 1.0])
def test_a_message_that_follows_no_other_is_sent_at_once(interval_s: float) -> None:
    world = Recorded()
    world.stream("pose", 20, interval_s)
    world.run(20 * interval_s + 0.5)
    assert [round(at, 6) for at, _ in world.sent] == [round(number * interval_s, 6) for number in range(20)]


def test_a_message_sent_after_the_acknowledgement_of_the_last_does_not_wait() -> None:
    """A request that follows each answer pays no packing time."""
    world = Recorded()
    answered: list[float] = []

    def next_one(name: str, event: object, now: float) -> None:
        if isinstance(event, MessageDelivered) and name == "a":
            answered.append(now)
            if len(answered) < 20:
                world.at(now, lambda: world.send("a", "pose", b"again", "b"))

    world.on_event = next_one
    world.send("a", "pose", b"first", "b")
    world.run(2.0)
    assert len(answered) == 20
    rtt_s = 2 * world.pipes["a", "b"].delay_s
    assert answered[-1] - world.began < 20 * (rtt_s + Rates().ack_delay_s + 0.001)


def test_urgent_messages_never_wait_for_others() -> None:
    world = Recorded()
    for pipe in world.pipes.values():
        pipe.delay_s = 0.0001
    world.stream("stop", 100, 0.0005)
    world.run(1.0)
    sent_at = {round(at, 6) for at, _ in world.sent}
    assert sent_at >= {round(number * 0.0005, 6) for number in range(100)}


def test_larger_messages_on_the_level_do_not_wait() -> None:
    world = Recorded()
    world.stream("pose", 4, 0.0001)
    world.at(world.now + 0.0005, lambda: world.send("a", "map", bytes(5000), "b"))
    world.run(0.001)
    assert max(size for at, size in world.sent if at <= 0.0006) > 1400


def test_messages_that_wait_are_sent_when_the_node_closes() -> None:
    world = Recorded()
    for _ in range(5):
        world.send("a", "pose", b"last", "b")
    world.nodes["a"].close(world.now)
    world.run(1.0)
    received = [event.payload for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert received[3:] == [b"last"] * 5


def test_the_application_limits_a_stream_that_waits_to_share_datagrams() -> None:
    """Otherwise its rate would be taken for that of the link."""
    world = Recorded()
    world.stream("pose", 2000, 0.0005)
    sender = world.nodes["a"]._state.peer_table.peers["b"].open_sender()
    limited = []
    for _ in range(50):
        world.run(0.0107)
        limited.append(sender.app_limited)
    assert all(limited)


def test_a_stream_requests_fewer_acknowledgements_than_it_has_datagrams() -> None:
    world = Recorded()
    before = world.nodes["b"].conditions(world.now).counters.acknowledgements_sent
    world.stream("pose", 2000, 0.0005)
    world.run(1.5)
    acknowledgments = world.nodes["b"].conditions(world.now).counters.acknowledgements_sent - before
    assert acknowledgments <= 0.6 * len(world.sent)


def test_a_peer_of_an_earlier_version_gets_long_heads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(heartbeat, "OWN_FEATURES", heartbeat.OWN_FEATURES & ~Feature.COMPACT)
    world = Recorded()
    world.stream("pose", 1000, 0.0001)
    world.run(1.0)
    assert len(world.events_of("b", MessageReceived)) == 1003
    assert sum(size for _, size in world.sent) / 1000 > 35
    assert max(size for _, size in world.sent) <= 1472
