"""What members can make a node do with tables and questions is bounded, and harms only themselves."""

from __future__ import annotations

from tests.udp_mesh.core.subscriptions.team import config, met, outcomes, read, received
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import ExpiryReason, MessageExpired
from udp_mesh.core.settings import Limits, Topic
from udp_mesh.core.subscriptions.messages import (
    ASK_TOPIC,
    MAX_GENERATION,
    TABLE_TOPIC,
    Bounds,
    Subscription,
    SubscriptionTable,
    encode_ask,
    encode_table,
)
from udp_mesh.core.subscriptions.own import INTERVAL_S, OwnSubscriptions
from udp_mesh.core.subscriptions.selection import MAX_PACED, MAX_WITHHELD_BYTES, MAX_WITHHELD_MESSAGES


def malformed(node: Endpoint, now: float) -> int:
    return node.conditions(now).counters.dropped_malformed


def test_garbage_on_the_reserved_topics_is_counted_and_dropped() -> None:
    world = met()
    before = malformed(world.nodes["a"], world.now)
    for number, payload in enumerate(
        (b"", b"\x07", bytes(20_000), encode_table(SubscriptionTable(1, (Subscription("t"),))) + b"x")
    ):
        world.send("b", TABLE_TOPIC, payload, "a")
        world.run(1.0)
        assert malformed(world.nodes["a"], world.now) == before + number + 1


def test_a_lying_generation_harms_only_its_sender() -> None:
    world = met(config("a"), config("b"), config("c"))
    world.send("b", TABLE_TOPIC, encode_table(SubscriptionTable(MAX_GENERATION, ())), "a")
    world.run(1.0)
    read(world, "b", "map")
    read(world, "c", "map")
    world.run(1.0)
    for peer in ("b", "c"):
        world.send("a", "map", b"one", peer)
    world.run(3.0)
    assert received(world, "c", "map") == [b"one"]
    assert not received(world, "b", "map")
    # Its next boot starts from the beginning.
    world.add(config("b"))
    world.run(3.0)
    world.send("a", "map", b"two", "b")
    world.run(1.0)
    assert received(world, "b", "map") == [b"two"]


def test_an_older_table_that_comes_late_changes_nothing() -> None:
    world = met()
    world.send("b", TABLE_TOPIC, encode_table(SubscriptionTable(100, (Subscription("map"),))), "a")
    world.run(0.5)
    world.send("b", TABLE_TOPIC, encode_table(SubscriptionTable(99, ())), "a")
    world.run(0.5)
    world.send("a", "map", b"one", "b")
    world.run(1.0)
    assert received(world, "b", "map") == [b"one"]


def test_a_flood_of_questions_gets_one_answer_a_second() -> None:
    world = met()
    table_datagrams: list[float] = []
    before = world.pipes["a", "b"].carried_bytes
    read(world, "a", *(f"topic/{number:03}" for number in range(400)))
    world.run(1.0)
    one_table = world.pipes["a", "b"].carried_bytes - before
    for _ in range(1000):
        world.send("b", ASK_TOPIC, encode_ask(), "a")
        world.run(0.01)
        table_datagrams.append(world.now)
    flooded = world.pipes["a", "b"].carried_bytes - before - one_table
    acknowledgments = 1000 * 100
    assert flooded < 12 * one_table + acknowledgments


def test_a_program_that_subscribes_in_a_loop_costs_a_few_tables_a_second() -> None:
    own = OwnSubscriptions(0.0)
    tables = 0
    world = met()
    session = world.nodes["a"]._state.peer_table.peers["b"].session
    assert session is not None
    now = 100.0
    own.on_ask(session, 10, now)
    for turn in range(1000):
        own.set([Subscription(f"t{turn}")], now)
        if own.next_at <= now:
            for one in own.due(now):
                own.on_announced(one, now, sent=True)
                tables += 1
        now += 0.01
    assert 10 < tables <= 10 / INTERVAL_S + 2


def test_followers_are_bounded() -> None:
    world = met()
    own = OwnSubscriptions(0.0)
    for name in ("a", "b"):
        for peer in world.nodes[name]._state.peer_table.peers.values():
            assert peer.session is not None
            own.on_ask(peer.session, 1, 100.0)
    assert len(own._followers) == 1


def test_a_program_that_sends_what_no_program_reads_fills_no_memory() -> None:
    world = met()
    state = world.nodes["a"]._state
    for _ in range(4 * MAX_WITHHELD_MESSAGES):
        world.send("a", "map", bytes(10), "b")
    assert len(state.selection._unread) == MAX_WITHHELD_MESSAGES
    for _ in range(20):
        world.send("a", "map", bytes(1 << 20), "b")
    assert state.selection._unread_bytes <= MAX_WITHHELD_BYTES
    world.run(3.0)
    ended = outcomes(world, "a", MessageExpired, "map")
    assert len(ended) == 4 * MAX_WITHHELD_MESSAGES + 20
    assert {event.reason for event in ended if isinstance(event, MessageExpired)} == {ExpiryReason.NOT_WANTED}
    assert not state.selection._unread


def test_topics_without_end_do_not_fill_the_table_of_rates() -> None:
    limits = Limits(topics_per_peer=2 * MAX_PACED)
    world = met(config("a", limits=limits), config("b", limits=limits))
    read(world, "b", "*", rate_hz=0.01)
    world.run(0.5)
    for number in range(MAX_PACED + 100):
        world.send("a", f"t{number}", b"x", "b")
    assert len(world.nodes["a"]._state.selection._paces) == MAX_PACED


def test_a_node_that_does_not_send_selectively_ignores_tables_and_questions() -> None:
    world = met(config("a", Topic("map"), selective=False), config("b"))
    for topic, payload in ((TABLE_TOPIC, encode_table(SubscriptionTable(5, ()))), (ASK_TOPIC, encode_ask())):
        world.send("b", topic, payload, "a")
    world.run(2.0)
    world.send("a", "map", b"one", "b")
    world.run(1.0)
    assert received(world, "b", "map") == [b"one"]


def test_tables_in_a_stream_leave_no_timers_behind() -> None:
    world = met()
    selection = world.nodes["a"]._state.selection
    for turn in range(500):
        table = SubscriptionTable(100 + turn, (Subscription("map", Bounds(0.001 + turn * 1e-6)),))
        world.send("b", TABLE_TOPIC, encode_table(table), "a")
        world.run(0.05)
        world.send("a", "map", b"%d" % turn, "b")
    assert len(selection._due) <= 64 + 2 * len(selection._paces)
    assert len(received(world, "b", "map")) == 1
