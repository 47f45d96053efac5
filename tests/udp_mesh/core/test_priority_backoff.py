"""Urgent traffic holds back less urgent levels of other nodes, for a bounded share of the time."""

from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import World, pair, settings
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.priority_backoff import ALL_LEVELS, BUDGET_S, PriorityBackoff
from udp_mesh.core.settings import Rates, Topic
from udp_mesh.wire.frames import Waiting


def test_lower_priority_levels_back_off_briefly_for_a_level_waiting_at_another_node() -> None:
    priority_backoff = PriorityBackoff(Rates(), 0.0)
    priority_backoff.on_waiting((Waiting(2, 50),), 1.0)
    assert priority_backoff.allowed_levels(1.05) == 0b111
    assert priority_backoff.allowed_levels(1.2) == ALL_LEVELS


def test_bulk_waiting_at_another_node_causes_no_backoff() -> None:
    priority_backoff = PriorityBackoff(Rates(), 0.0)
    priority_backoff.on_waiting((Waiting(9, 60_000),), 1.0)
    assert priority_backoff.allowed_levels(1.0) == ALL_LEVELS


@given(st.lists(st.tuples(st.floats(0.0, 0.3), st.integers(0, 3)), max_size=80))
def test_no_level_is_held_back_for_more_than_its_share_of_the_time(reports: list[tuple[float, int]]) -> None:
    rates = Rates()
    priority_backoff, now = PriorityBackoff(rates, 0.0), 0.0
    for wait, level in reports:
        now += wait
        priority_backoff.on_waiting((Waiting(level, 100),), now)
    assert priority_backoff.held_total_s <= rates.yield_share * (now + BUDGET_S) + 1e-6


def test_bulk_backs_off_while_another_node_has_urgent_messages_waiting() -> None:
    world = World(seed=6)
    topics = (Topic("stop", priority=0), Topic("bulk", priority=9))
    for name in ("a", "b", "c"):
        world.add(settings(name, *topics))
    world.run(2.0)
    # b's urgent messages crawl to c: b reports so whenever it acknowledges a's bulk.
    world.pipes[("b", "c")].rate_bits_per_s = 20_000
    for _ in range(10):
        world.send("b", "stop", bytes(1000), "c")
    world.send("a", "bulk", bytes(300_000), "b")
    world.run(0.5)
    held_s = world.nodes["a"]._state.priority_backoff.held_total_s
    assert held_s > 0
    queues = {queue.priority: queue for queue in world.nodes["a"].conditions(world.now).peers[0].queues}
    # The reported hold-back of the level is no more than the node's total.
    assert 0 < queues[9].held_s <= held_s + 1e-9
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))


def test_a_broadcast_that_is_held_back_wakes_its_node_when_it_may_be_sent_and_not_before() -> None:
    both = pair(Topic("news", priority=9))
    both.a._state.priority_backoff.on_waiting((Waiting(2, 50),), both.now)
    both.a.send("news", b"x", now=both.now)
    both.leave(both.a)
    assert both.a._state.broadcasts.waiting
    at = both.a.next_timer()
    assert at is not None
    assert at > both.now
    both.now += Rates().yield_hold_s
    assert at <= both.now
    both.leave(both.a)
    assert not both.a._state.broadcasts.waiting
