"""One bound on what waits for all peers: it refuses new messages, keeps accepted ones, and has room for urgent ones."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageId, Rejected, RejectReason
from udp_mesh.core.sender.message import AcceptedMessage, TopicChannel
from udp_mesh.core.sender.send_memory import COPY_BYTES, SendMemory
from udp_mesh.core.settings import Limits, Outbox, Rates, Topic

TOTAL = 1_000_000
SIZE = 10_000
RATES = Rates(offline_s=3.0, peer_lost_s=1000.0, heartbeat_sparse_s=1.0)
TOPICS = (
    Topic("stop", priority=0),
    Topic("map", priority=9),
    Topic("kept", priority=9, outbox=Outbox.ALL, outbox_bytes=1 << 30),
    Topic("packed", priority=9, compression=True),
)
PEERS = tuple("bcdef")


def cut_off_team(*peers: str, limits: Limits | None = None) -> World:
    """Node a has met these peers, and no datagram arrives any more."""
    world = World(seed=2)
    world.add(settings("a", *TOPICS, rates=RATES, limits=limits or Limits(queue_bytes=TOTAL)))
    for name in peers:
        world.add(settings(name, *TOPICS, rates=RATES))
    world.run(3.0)
    set_up(world, up=False)
    return world


def set_up(world: World, *, up: bool) -> None:
    for pipe in world.pipes.values():
        pipe.up = up


def memory(world: World) -> SendMemory:
    return world.nodes["a"]._state.peer_table.send_memory


def fill(world: World, topic: str, *names: str | None, size: int = SIZE) -> tuple[int, Rejected]:
    """Send to these in turn until a message is refused: how many were accepted, and what was said then."""
    for number in range(100_000):
        answer = world.send("a", topic, bytes(size), names[number % len(names)])
        if isinstance(answer, Rejected):
            return number, answer
    raise AssertionError("everything is accepted")


def test_what_waits_for_all_peers_is_bounded_and_arrives() -> None:
    world = cut_off_team(*PEERS)
    accepted, refused = fill(world, "map", *PEERS)
    assert refused.reason is RejectReason.QUEUE_FULL
    assert memory(world).bytes <= TOTAL
    # Each has used its share of the second half in the first one.
    assert accepted * SIZE > TOTAL * 0.4
    set_up(world, up=True)
    assert world.run(60.0, until=lambda: len(world.events_of("a", MessageDelivered)) == accepted)
    assert memory(world).bytes == 0


def test_outboxes_for_names_that_are_never_heard_are_bounded() -> None:
    world = cut_off_team()
    _, refused = fill(world, "kept", *(f"robot{number}" for number in range(50)))
    assert refused.reason is RejectReason.QUEUE_FULL
    assert memory(world).bytes <= TOTAL


def test_tiny_messages_count_with_their_overhead() -> None:
    world = cut_off_team(*PEERS)
    accepted, _ = fill(world, "map", *PEERS, size=1)
    assert accepted < TOTAL / 500


def test_a_message_that_is_being_compressed_counts() -> None:
    world = cut_off_team(*PEERS)
    answers = [world.nodes["a"].send("packed", bytes(100_000), destination="b", now=world.now) for _ in range(20)]
    assert isinstance(answers[-1], Rejected)
    world.run(1.0)
    assert memory(world).bytes <= TOTAL


def test_no_bulk_makes_a_node_refuse_urgent_messages() -> None:
    world = cut_off_team(*PEERS)
    fill(world, "map", *PEERS)
    assert isinstance(world.send("a", "stop", bytes(SIZE), "b"), int)
    assert isinstance(world.send("a", "stop", bytes(SIZE)), int)
    _, refused = fill(world, "stop", *PEERS)
    assert refused.reason is RejectReason.QUEUE_FULL
    assert memory(world).bytes <= TOTAL * 1.25


def test_no_bulk_to_a_peer_makes_a_node_refuse_urgent_messages_to_it() -> None:
    for limits in (Limits(queue_bytes_per_peer=TOTAL), Limits(queue_messages_per_peer=20)):
        world = cut_off_team("b", limits=limits)
        fill(world, "map", "b")
        assert isinstance(world.send("a", "stop", bytes(SIZE), "b"), int)
        assert isinstance(world.send("a", "stop", bytes(2 * SIZE)), int)
        _, refused = fill(world, "stop", "b")
        assert refused.reason is RejectReason.QUEUE_FULL


def test_a_message_to_several_peers_counts_once() -> None:
    world = cut_off_team(*PEERS)
    assert isinstance(world.send("a", "map", bytes(400_000)), int)
    assert 400_000 < memory(world).bytes < 500_000
    assert isinstance(world.send("a", "map", bytes(40_000)), int)
    set_up(world, up=True)
    assert world.run(60.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 2 * len(PEERS))
    assert memory(world).bytes == 0


def test_a_peer_that_takes_nothing_leaves_room_for_others() -> None:
    world = cut_off_team(*PEERS)
    _, refused = fill(world, "map", "b")
    assert "each peer may use" in refused.detail
    assert memory(world).bytes < TOTAL * 0.6
    for name in PEERS[1:]:
        assert isinstance(world.send("a", "map", bytes(SIZE), name), int)


def test_what_ends_without_being_sent_is_released() -> None:
    world = cut_off_team("b", "c")
    for topic in ("map", "kept", "packed"):
        for name in ("b", "c", None):
            world.send("a", topic, bytes(SIZE), name)
    world.run(10.0)
    assert memory(world).bytes > 6 * SIZE
    world.nodes["a"].close(world.now)
    assert memory(world).bytes == 0


COPIES = st.lists(st.tuples(st.sampled_from(PEERS), st.integers(0, 5)), max_size=60)
"""Peer and message of each copy. Even messages are compressed: both forms are kept."""


@given(COPIES, st.randoms())
def test_the_counts_are_those_of_all_copies_added_up(copies: list[tuple[str, int]], rng: random.Random) -> None:
    """Each copy is added once and removed once, in any order; after each step all of them are counted."""
    channel = TopicChannel(0, TOPICS[1], "map", "")
    payloads = [bytes(1000 + number) for number in range(6)]
    bodies = [payload if number % 2 else payload[:100] for number, payload in enumerate(payloads)]
    held_bytes = [1100, 1001, 1102, 1003, 1104, 1005]
    counted, waiting = SendMemory(TOTAL), list[tuple[str, AcceptedMessage]]()
    to_add = [
        (peer, AcceptedMessage(MessageId(number), channel, payloads[number], bodies[number], 0, 0.0, None))
        for peer, number in copies
    ]
    while to_add or waiting:
        if to_add and (not waiting or rng.random() < 0.6):
            waiting.append(to_add.pop())
            counted.add(*waiting[-1])
        else:
            counted.remove(*waiting.pop(rng.randrange(len(waiting))))
        messages = {accepted.message_id for _, accepted in waiting}
        assert counted.bytes == sum(held_bytes[number] for number in messages) + COPY_BYTES * len(waiting)
        for peer in PEERS:
            theirs = [held_bytes[accepted.message_id] + COPY_BYTES for name, accepted in waiting if name == peer]
            assert counted.waiting_bytes(peer) == sum(theirs)
        assert counted.share() == TOTAL // 2 // max(1, len({peer for peer, _ in waiting}))
