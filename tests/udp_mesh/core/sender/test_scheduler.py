"""Strict priority, decided per fragment when a datagram is built."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import World, pair, settings
from udp_mesh.core.events import MessageId, MessageReceived, TopicStarved
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.scheduler import Run, Scheduler
from udp_mesh.core.settings import Topic
from udp_mesh.wire.frames import MessageFlag


def outgoing(priority: int, fragments: int, *, queued_at: float = 0.0) -> OutgoingMessage:
    channel = TopicChannel(0, Topic("t", priority=priority), "t", "")
    body = bytes(10 * fragments)
    message = OutgoingMessage(
        AcceptedMessage(MessageId(1), channel, body, body, MessageFlag.RELIABLE, queued_at, None),
        priority,
        reliable=True,
    )
    message.begin(1, 10, 10)
    return message


steps = st.lists(
    st.one_of(
        st.tuples(st.just("push"), st.integers(0, 15), st.integers(1, 5)),
        st.tuples(st.just("take"), st.integers(1, 3), st.just(0)),
        st.tuples(st.just("lose"), st.integers(0, 50), st.just(0)),
        st.tuples(st.just("aside"), st.integers(0, 15), st.just(0)),
        st.tuples(st.just("alternate"), st.integers(0, 15), st.just(0)),
    ),
    max_size=60,
)


@given(steps)
def test_every_fragment_is_sent_in_strict_priority_order(
    plan: list[tuple[str, int, int]],
) -> None:
    scheduler = Scheduler()
    waiting: list[tuple[int, int]] = []
    """(priority, serial of the message) of every waiting fragment: the simple slow model."""
    messages: list[OutgoingMessage] = []
    left: list[tuple[OutgoingMessage, int]] = []

    def take(most: int) -> None:
        if not scheduler.waiting:
            return
        priority = (scheduler.waiting & -scheduler.waiting).bit_length() - 1
        run = scheduler.peek(priority)
        if run is None:
            return
        count = min(most, run.length)
        scheduler.consume(run, count)
        for position in range(run.position, run.position + count):
            assert run.message.priority == min(level for level, _ in waiting)
            waiting.remove((run.message.priority, messages.index(run.message)))
            left.append((run.message, position))

    for what, number, size in plan:
        if what == "push":
            message = outgoing(number, size, queued_at=float(len(messages)))
            messages.append(message)
            scheduler.push(message)
            waiting.extend([(number, len(messages) - 1)] * size)
        elif what == "take":
            take(number)
        elif what == "lose" and left:
            message, position = left.pop(number % len(left))
            scheduler.push_retransmit(message, position)
            waiting.append((message.priority, messages.index(message)))
        elif what == "aside":
            scheduler.demote_stale(number)
        elif what == "alternate":
            scheduler.alternate_stale(number, messages[len(messages) // 2].queued_at if messages else 0.0)
    while scheduler.waiting:
        take(3)
    assert not waiting
    assert len(left) == sum(message.fragments for message in messages)


def test_fresh_urgent_messages_are_sent_before_demoted_stale_ones() -> None:
    scheduler = Scheduler()
    stale, fresh = outgoing(0, 1), outgoing(0, 1)
    scheduler.push(stale)
    scheduler.demote_stale(3)
    scheduler.push(fresh)
    order = []
    while (run := scheduler.peek(0)) is not None:
        scheduler.consume(run, 1)
        order.append(run.message)
    assert order == [fresh, stale]


def test_other_levels_send_stale_and_fresh_messages_in_turn() -> None:
    scheduler = Scheduler()
    messages = [outgoing(9, 1, queued_at=float(second)) for second in range(8)]
    for message in messages[:5]:
        scheduler.push(message)
    scheduler.alternate_stale(4, 5.0)
    for message in messages[5:]:
        scheduler.push(message)
    order = []
    while (run := scheduler.peek(9)) is not None:
        scheduler.consume(run, 1)
        order.append(messages.index(run.message))
    assert order == [5, 0, 6, 1, 7, 2, 3, 4]


def test_a_parked_message_returns_to_its_place_among_those_of_its_topic() -> None:
    """In front of its level, behind earlier messages of its topic and before later ones."""

    def message(number: int, channel: TopicChannel) -> OutgoingMessage:
        accepted = AcceptedMessage(MessageId(number), channel, b"x", b"x", MessageFlag.RELIABLE, 0.0, None)
        return OutgoingMessage(accepted, 9, reliable=True)

    one, other = (TopicChannel(number, Topic("t", priority=9), f"t{number}", "") for number in range(2))
    scheduler = Scheduler()
    messages = {number: message(number, other if number == 5 else one) for number in range(1, 7)}
    for number in (1, 2, 4, 5, 6):
        scheduler.push(messages[number])
    scheduler.restore(messages[3])
    order = []
    while (run := scheduler.peek(9)) is not None:
        scheduler.consume(run, 1)
        order.append(run.message.accepted.message_id)
    assert order == [1, 2, 3, 4, 5, 6]
    scheduler.push(messages[5])
    scheduler.restore(messages[3])
    first = scheduler.peek(9)
    assert first is not None
    assert first.message is messages[3]


def test_a_level_fills_a_datagram_by_what_waits_on_it_now() -> None:
    """Parking, restoring and sending keep account of it: else messages would wait for others that are here, or not wait
    at all."""
    scheduler = Scheduler()
    messages = [outgoing(9, 1) for _ in range(4)]
    scheduler.push(messages[0])
    one_bytes = next(size for size in range(1, 200) if not scheduler.fills(9, size + 1))
    for message in messages[1:]:
        scheduler.push(message)

    def waiting() -> int:
        return next(count for count in range(5) if not scheduler.fills(9, count * one_bytes + 1))

    def head() -> Run:
        run = scheduler.peek(9)
        assert run is not None
        return run

    assert waiting() == 4
    parked = head().message
    scheduler.park_head(head())
    assert waiting() == 3
    scheduler.restore(parked)
    assert waiting() == 4
    scheduler.consume(head(), 1)
    assert waiting() == 3
    scheduler.alternate_stale(5, -1.0)
    assert waiting() == 3
    scheduler.push_retransmit(messages[0], 0)
    assert scheduler.fills(9, 1_000_000)


def test_an_urgent_message_is_sent_next_in_the_middle_of_a_bulk_transfer() -> None:
    both = pair(Topic("stop", priority=0), Topic("map", priority=9))
    both.a.send("map", bytes(20_000_000), destination="b", now=both.now)
    both.roundtrip(times=20)
    both.a.send("stop", b"now", destination="b", now=both.now)
    first = both.drop(both.a)[0]
    assert isinstance(first, Datagram)
    assert first.urgent
    both.events(both.b)
    both.b.receive(first.data, "mesh", ("10.0.0.1", 8700), both.now)
    assert [event.topic for event in both.events(both.b) if isinstance(event, MessageReceived)] == ["stop"]


def test_priority_order_holds_across_different_peers() -> None:
    world = World()
    topics = (Topic("high", priority=5), Topic("low", priority=12))
    for name in ("a", "b", "c"):
        world.add(settings(name, *topics))
    world.run(2.0)
    node = world.nodes["a"]
    node.send("low", b"l" * 500, destination="c", now=world.now)
    node.send("high", b"h" * 500, destination="b", now=world.now)
    out = [datagram for datagram in node.datagrams_to_send(world.now) if len(datagram.data) > 500]
    assert [datagram.destination for datagram in out] == [world.addresses["b"], world.addresses["c"]]


def test_a_starved_priority_level_is_reported() -> None:
    world = World()
    topics = (Topic("hog", priority=5), Topic("starving", priority=12))
    for name in ("a", "b"):
        world.add(settings(name, *topics))
    world.run(1.5)
    for _ in range(20):
        world.send("a", "hog", bytes(1_000_000), "b")
    world.send("a", "starving", b"please", "b")
    world.run(8.0)
    events = world.events_of("a", TopicStarved)
    assert [event.topic for event in events if isinstance(event, TopicStarved)] == ["starving"]
    queues = {queue.priority: queue for queue in world.nodes["a"].conditions(world.now).peers[0].queues}
    assert queues[12].starved_s > 5
    assert queues[5].starved_s == 0


def test_the_time_until_a_queue_is_sent_is_what_it_takes() -> None:
    world = World()
    topics = (Topic("urgent", priority=5), Topic("bulk", priority=12))
    for name in ("a", "b"):
        world.add(settings(name, *topics))
    world.run(1.5)
    # measured with messages before: the capacity is not known at once
    for topic in ("urgent", "bulk", "bulk"):
        world.send("a", topic, bytes(2_000_000), "b")
    world.run(3.0)
    peer = world.nodes["a"].conditions(world.now).peers[0]
    waiting = {queue.priority: queue for queue in peer.queues if queue.messages}
    estimated_s = waiting[12].drained_in_s
    assert estimated_s is not None
    assert peer.capacity_bits_per_s is not None
    expected = sum(queue.bytes for queue in waiting.values()) * 8 / peer.capacity_bits_per_s
    assert estimated_s == pytest.approx(expected)
    started = world.now
    while any(queue.messages for queue in world.nodes["a"].conditions(world.now).peers[0].queues):
        world.run(0.1)
        assert world.now - started < 10 * estimated_s
    assert world.now - started == pytest.approx(estimated_s, rel=0.5)


def test_the_time_until_a_queue_is_sent_is_unknown_while_the_peer_is_offline() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("bulk", priority=12)))
    world.run(1.5)
    world.send("a", "bulk", bytes(20_000_000), "b")
    world.run(1.0)
    for pipe in world.pipes.values():
        pipe.up = False
    world.run(30.0)
    (peer,) = world.nodes["a"].conditions(world.now).peers
    assert not peer.online
    assert {queue.drained_in_s for queue in peer.queues} <= {None}


def test_a_level_would_get_what_more_urgent_ones_leave() -> None:
    world = World()
    topics = (Topic("urgent", priority=2), Topic("video", priority=6), Topic("bulk", priority=12))
    for name in ("a", "b"):
        world.add(settings(name, *topics))
    world.run(1.5)
    assert world.nodes["a"].conditions(world.now).peers[0].available_bits_per_s is None
    world.send("a", "bulk", bytes(20_000_000), "b")
    for _ in range(200):
        world.send("a", "urgent", bytes(2_500), "b")
        world.send("a", "video", bytes(10_000), "b")
        world.run(0.05)
    (peer,) = world.nodes["a"].conditions(world.now).peers
    available = peer.available_bits_per_s
    assert available is not None
    assert available[:3] == (round(peer.capacity_bits_per_s or 0),) * 3
    # 20 messages per second of each topic, with some percent of headers
    assert available[2] - available[3] == pytest.approx(20 * 2_500 * 8, rel=0.15)
    assert available[3] == available[6]
    assert available[6] - available[7] == pytest.approx(20 * 10_000 * 8, rel=0.15)
    assert available[7] == available[12] > 5 * available[13]
    assert min(available) >= 0


def test_a_level_gets_the_rate_that_was_reported() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("video", priority=6), Topic("bulk", priority=12)))
    world.run(1.5)
    world.send("a", "bulk", bytes(2_000_000), "b")
    for step in range(80):
        if step == 40:
            (before,) = world.nodes["a"].conditions(world.now).peers
            world.send("a", "bulk", bytes(20_000_000), "b")
        world.send("a", "video", bytes(25_000), "b")
        world.run(0.1)
    (after,) = world.nodes["a"].conditions(world.now).peers
    assert before.available_bits_per_s is not None
    bulk_bits_per_s = after.delivered_bits_per_s - 10 * 25_000 * 8
    assert bulk_bits_per_s == pytest.approx(before.available_bits_per_s[12], rel=0.1)
