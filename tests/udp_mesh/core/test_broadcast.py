"""Broadcasts: one datagram if the message fits, copies otherwise, repair, and outboxes for offline peers."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest

from tests.udp_mesh.core.pair import BROADCAST, World, pair, settings
from tests.udp_mesh.disk import Disk
from udp_mesh.core.broadcast import MAX_MISSING, NackRepair
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageReceived,
    PeerOffline,
    PeerOnline,
    Rejected,
    RejectReason,
)
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.settings import Outbox, Rates, Topic

TEAM = ("a", "b", "c", "d")
QUICK = Rates(offline_s=3.0, peer_lost_s=6.0)


def team(*topics: Topic, rates: Rates = QUICK) -> World:
    world = World(seed=2)
    for name in TEAM:
        world.add(settings(name, *topics, rates=rates))
    world.run(2.0)
    return world


def payloads(world: World, name: str) -> list[bytes]:
    return [event.payload for event in world.events_of(name, MessageReceived) if isinstance(event, MessageReceived)]


def test_a_broadcast_that_fits_is_sent_as_a_single_datagram() -> None:
    world = team()
    sent: list[Datagram] = []
    world.tap = lambda name, datagram, now: sent.append(datagram) if name == "a" and len(datagram.data) > 900 else None
    world.send("a", "any", bytes(1000))
    world.run(0.1)
    assert [datagram.destination for datagram in sent] == [BROADCAST]
    assert [payloads(world, name) for name in "bcd"] == [[bytes(1000)]] * 3


def test_an_oversized_broadcast_is_sent_to_each_peer_with_one_outcome_per_peer() -> None:
    world = team()
    world.send("a", "any", bytes(5000))
    world.run(1.0)
    assert [payloads(world, name) for name in "bcd"] == [[bytes(5000)]] * 3
    assert sorted(
        event.peer for event in world.events_of("a", MessageDelivered) if isinstance(event, MessageDelivered)
    ) == [
        "b",
        "c",
        "d",
    ]


def test_a_topic_with_destinations_is_sent_only_to_them() -> None:
    world = team(Topic("t", destinations=("b", "d")))
    world.send("a", "t", b"for two")
    world.run(0.5)
    assert [payloads(world, name) for name in "bcd"] == [[b"for two"], [], [b"for two"]]


@pytest.mark.parametrize("loss", [0.1, 0.3])
def test_a_lost_broadcast_with_repair_is_received_exactly_once(loss: float) -> None:
    world = team(Topic("t", repair=True))
    for pipe in world.pipes.values():
        pipe.loss = loss
    for number in range(40):
        world.send("a", "t", bytes([number]))
        world.run(0.05)
    world.run(10.0)
    for name in "bcd":
        assert sorted(payloads(world, name)) == [bytes([number]) for number in range(40)]


def test_broadcasts_without_repair_trigger_no_repair_requests() -> None:
    world = team(Topic("t"))
    for pipe in world.pipes.values():
        pipe.loss = 0.3
    for number in range(40):
        world.send("a", "t", bytes([number]))
        world.run(0.05)
    assert 15 < len(payloads(world, "b")) < 40
    assert world.nodes["b"].conditions(world.now).counters.repairs_asked == 0


def test_a_repair_request_stops_when_the_broadcast_is_no_longer_kept() -> None:
    world = team(Topic("t", repair=True))
    world.nodes["a"]._state.broadcasts._repairable.clear()
    world.pipes[("a", "b")].up = False
    world.send("a", "t", b"gone")
    world.run(0.001)
    world.nodes["a"]._state.broadcasts._repairable.clear()
    world.pipes[("a", "b")].up = True
    world.run(5.0)
    asked = world.nodes["b"].conditions(world.now).counters.repairs_asked
    assert 1 <= asked <= 2
    assert payloads(world, "b") == []


def test_urgent_broadcasts_are_sent_redundantly_on_a_lossy_link() -> None:
    world = team(Topic("stop", priority=0))
    for pipe in world.pipes.values():
        pipe.loss = 0.2
    for _ in range(100):
        world.send("a", "any", bytes(1400), "b")
    world.run(3.0)
    for number in range(100):
        world.send("a", "stop", bytes([number]))
        world.run(0.02)
    arrived = [payload for payload in payloads(world, "c") if len(payload) == 1]
    assert len(arrived) == len(set(arrived))
    assert len(arrived) > 90


def out_of_reach(world: World, up: bool) -> None:
    for (source, sink), pipe in world.pipes.items():
        if "b" in (source, sink):
            pipe.up = up


@pytest.mark.parametrize(
    ("outbox", "expected"),
    [(Outbox.NONE, []), (Outbox.LAST, [b"2"]), (Outbox.ALL, [b"0", b"1", b"2"])],
)
def test_the_topic_sets_which_messages_an_outbox_keeps_for_an_offline_peer(
    outbox: Outbox, expected: list[bytes]
) -> None:
    world = team(Topic("t", outbox=outbox))
    out_of_reach(world, up=False)
    assert world.run(10.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    world.run(30.0)
    for number in range(3):
        world.send("a", "t", str(number).encode(), "b")
    world.run(1.0)
    out_of_reach(world, up=True)
    world.run(10.0)
    assert payloads(world, "b") == expected


def test_a_full_outbox_drops_the_oldest_messages() -> None:
    world = team(Topic("t", outbox=Outbox.ALL, outbox_bytes=2500))
    out_of_reach(world, up=False)
    assert world.run(10.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    for number in range(4):
        world.send("a", "t", bytes([number]) * 1000, "b")
    gone = [event for event in world.events_of("a", MessageExpired) if isinstance(event, MessageExpired)]
    assert [(event.message_id, event.reason) for event in gone] == [
        (1, ExpiryReason.OUTBOX_FULL),
        (2, ExpiryReason.OUTBOX_FULL),
    ]
    out_of_reach(world, up=True)
    world.run(10.0)
    assert [payload[0] for payload in payloads(world, "b")] == [2, 3]


def test_an_outbox_on_disk_survives_a_restart_until_its_messages_are_delivered() -> None:
    topic = Topic("t", outbox=Outbox.ALL, outbox_on_disk=True)
    world, disk = World(), Disk()
    world.add(settings("a", topic), store=disk)
    world.send("a", "t", b"for later", "b")
    assert len(disk.kept) == 1
    world.run(1.0)
    world.add(settings("a", topic), store=disk)
    world.run(1.0)
    world.add(settings("b", topic))
    assert world.run(10.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    assert payloads(world, "b") == [b"for later"]
    assert disk.kept == {}


@pytest.mark.parametrize("destination", ["a", None])
def test_a_message_to_oneself_is_refused(destination: str | None) -> None:
    """It would wait in the outbox forever; and a topic for this node alone is not one for all."""
    world = team(Topic("t", destinations=("a",), outbox=Outbox.ALL))
    answer = world.send("a", "t", b"x", destination)
    assert isinstance(answer, Rejected)
    assert answer.reason is RejectReason.UNKNOWN_PEER
    assert answer.detail == "a is this node, and messages go to others"


def test_a_message_to_an_unknown_peer_requires_an_outbox() -> None:
    both = pair(Topic("t"), Topic("kept", outbox=Outbox.ALL))
    answer = both.a.send("t", b"x", destination="nobody", now=both.now)
    assert isinstance(answer, Rejected)
    assert answer.reason is RejectReason.UNKNOWN_PEER
    assert isinstance(both.a.send("kept", b"x", destination="nobody", now=both.now), int)


@pytest.mark.parametrize(
    ("send", "reason"),
    [
        (lambda both: both.a.send("t", bytes(2_000_000), destination="b", now=both.now), RejectReason.TOO_LARGE),
        (
            lambda both: [both.a.send("t", bytes(900_000), destination="b", now=both.now) for _ in range(4)][-1],
            RejectReason.QUEUE_FULL,
        ),
    ],
)
def test_a_message_over_the_size_or_queue_limit_is_rejected_immediately(
    send: Callable[[object], object], reason: RejectReason
) -> None:
    from udp_mesh.core.settings import Limits

    both = pair(Topic("t"), limits=Limits(message_bytes=1_000_000, queue_bytes_per_peer=2_000_000))
    answer = send(both)
    assert isinstance(answer, Rejected)
    assert answer.reason is reason


def test_a_closed_node_rejects_messages_and_expires_open_ones() -> None:
    both = pair()
    both.a.send("any", bytes(100_000), destination="b", now=both.now)
    both.a.close(both.now)
    ends = [event for event in both.events(both.a) if isinstance(event, MessageExpired)]
    assert [end.reason for end in ends] == [ExpiryReason.CLOSED]
    assert isinstance(both.a.send("any", b"x", destination="b", now=both.now), Rejected)
    assert both.a.next_timer() is None


def test_an_outbox_delivers_to_a_peer_first_met_after_the_send() -> None:
    world = World(seed=3)
    dice = random.Random(3)
    topic = Topic("log", outbox=Outbox.ALL)
    world.add(settings("scout", topic, rates=QUICK))
    world.add(settings("base", topic, rates=QUICK))
    for pipe in world.pipes.values():
        pipe.up = False
    data = dice.randbytes(40_000)
    world.send("scout", "log", data, "base")
    world.run(60.0)
    assert not world.events_of("scout", PeerOnline)
    for pipe in world.pipes.values():
        pipe.up = True
    assert world.run(20.0, until=lambda: bool(world.events_of("scout", MessageDelivered)))
    assert payloads(world, "base") == [data]


def test_a_sender_whose_numbers_keep_jumping_ahead_causes_few_requests() -> None:
    repairs = NackRepair(random.Random(1))
    for jump in range(100):
        repairs.on_counter(1000 * jump, 0.0, RangeSet())
    requested = [nack.message_id for nack in repairs.due_nacks(1.0)]
    assert requested == list(range(99_000 - MAX_MISSING, 99_000))


def test_broadcasts_that_are_not_urgent_are_spread_over_time() -> None:
    """Radios send them at their lowest rate: many at once would fill the air."""
    both = pair(Topic("news", priority=9), rates=Rates(broadcast_packets_per_s=100.0))
    for number in range(30):
        both.a.send("news", b"%d" % number, now=both.now)
    sent: list[float] = []
    begin = both.now
    while len(sent) < 30:
        assert both.now < begin + 1.0
        sent += [both.now - begin for datagram in both.drop(both.a) if datagram.destination == BROADCAST]
        both.now += 0.001
    assert sent.count(sent[0]) <= 2
    assert sent[-1] >= 0.27
