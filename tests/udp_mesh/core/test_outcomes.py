"""Every accepted reliable message ends, per destination, in exactly one of delivered, expired, peer lost.

A delivered one arrived completely, once per run of its receiver.
"""

import random
from collections import Counter

import pytest

from tests.udp_mesh.core.pair import Pipe, World, pair, settings
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessagePeerLost,
    MessageReceived,
    PeerRestarted,
    Rejected,
)
from udp_mesh.core.settings import Rates, Topic

QUICK = Rates(offline_s=3.0, peer_lost_s=6.0)


def outcomes(world: World, name: str) -> Counter[tuple[int, str]]:
    ends: Counter[tuple[int, str]] = Counter()
    for _, event in world.events[name]:
        if isinstance(event, MessageDelivered | MessageExpired | MessagePeerLost):
            ends[(event.message_id, event.peer)] += 1
    return ends


def test_delivered_messages_arrive_complete_and_exactly_once() -> None:
    world = World(seed=5)
    world.add(settings("a"))
    world.add(settings("b"))
    world.run(1.5)
    for pipe in world.pipes.values():
        pipe.loss = 0.3
    payloads = [bytes([number]) * (number * 97) for number in range(120)]
    for payload in payloads:
        world.send("a", "any", payload, "b")
        world.run(0.02)
    assert world.run(60.0, until=lambda: len(world.events_of("a", MessageDelivered)) == len(payloads))
    received = [event.payload for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert sorted(received) == sorted(payloads)


def test_a_message_past_its_deadline_expires_with_reason_deadline() -> None:
    both = pair(Topic("t", deadline_s=0.1))
    both.a.send("t", b"late", destination="b", now=both.now)
    for _ in range(150):
        both.drop(both.a)
        both.now += 0.01
    ends = [event for event in both.events(both.a) if isinstance(event, MessageExpired)]
    assert [end.reason for end in ends] == [ExpiryReason.DEADLINE]
    both.roundtrip(times=20)
    assert not any(isinstance(event, MessageReceived) for event in both.events(both.b))


def test_a_message_that_arrived_in_time_is_delivered_although_its_acknowledgement_is_late() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("order", deadline_s=0.3)))
    for pipe in world.pipes.values():
        pipe.delay_s = 0.2
    world.run(10.0)
    for number in range(20):
        world.send("a", "order", b"%d" % number, destination="b")
        world.run(1.0)
    assert len(world.events_of("b", MessageReceived)) == 20
    assert len(world.events_of("a", MessageDelivered)) == 20
    assert world.events_of("a", MessageExpired) == []


def test_a_message_that_did_not_arrive_expires_soon_after_its_deadline() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("order", deadline_s=0.3)))
    world.run(10.0)
    world.pipes["a", "b"].up = False
    world.send("a", "order", b"lost", destination="b")
    sent_at = world.now
    world.run(5.0)
    ((expired_at, _),) = [entry for entry in world.events["a"] if isinstance(entry[1], MessageExpired)]
    assert 0.299 <= expired_at - sent_at <= 1.31


def test_keep_last_1_queues_only_the_newest_message() -> None:
    both = pair(Topic("pose", keep_last=1))
    ids = [both.a.send("pose", bytes([number]), destination="b", now=both.now) for number in range(5)]
    both.roundtrip(times=10)
    received = [event.payload for event in both.events(both.b) if isinstance(event, MessageReceived)]
    assert received == [bytes([4])]
    ends = [event for event in both.events(both.a) if isinstance(event, MessageExpired | MessageDelivered)]
    assert [type(end) for end in ends] == [MessageExpired] * 4 + [MessageDelivered]
    assert [end.message_id for end in ends] == ids


def test_messages_to_a_peer_that_stays_silent_end_as_peer_lost() -> None:
    world = World()
    world.add(settings("a", rates=QUICK))
    world.add(settings("b", rates=QUICK))
    world.run(1.5)
    for pipe in world.pipes.values():
        pipe.up = False
    world.send("a", "any", b"x" * 5000, "b")
    world.run(4.0)
    assert not world.events_of("a", MessagePeerLost)
    assert world.run(6.0, until=lambda: bool(world.events_of("a", MessagePeerLost)))
    assert not outcomes(world, "a") - Counter({(1, "b"): 1})


def test_a_receiver_restarted_mid_transfer_gets_the_whole_message() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name))
    world.pipes[("a", "b")] = Pipe(rate_bits_per_s=4e6)
    world.run(1.5)
    payload = random.Random(1).randbytes(1_000_000)
    world.send("a", "any", payload, "b")
    world.run(0.8)
    world.add(settings("b"))
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    assert world.events_of("a", PeerRestarted)
    received = [event for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert [event.payload for event in received] == [payload]


@pytest.mark.parametrize("type_name", ["a\nb", "\x1b[2J", "\ud800", "x" * 256])
def test_an_invalid_type_name_is_rejected_without_blocking_later_messages(type_name: str) -> None:
    two = pair(Topic("status", priority=0))
    assert isinstance(two.a.send("status", b"x", destination="b", type_name=type_name, now=two.now), Rejected)
    assert not isinstance(two.a.send("status", b"after", destination="b", now=two.now), Rejected)
    two.roundtrip(3)
    assert [event.payload for event in two.events(two.b) if isinstance(event, MessageReceived)] == [b"after"]
