"""Changes of a running node drop no accepted message and take effect at once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from tests.udp_mesh.core.pair import World, pair, settings
from udp_mesh.core.events import MessageDelivered, MessageId, MessageReceived, Rejected
from udp_mesh.core.settings import Limits, Neighbour, Outbox, Rates, Settings, Topic


def test_changing_settings_during_transfers_loses_no_messages() -> None:
    world = World(seed=4)
    base = settings("a", Topic("one", priority=5), Topic("two", priority=9))
    world.add(base)
    world.add(settings("b", Topic("one", priority=5), Topic("two", priority=9)))
    world.run(1.5)
    for pipe in world.pipes.values():
        pipe.loss = 0.05
    sent = 0
    changes: list[dict[str, object]] = [
        {"window": 3},
        {"window": "adaptive"},
        {"topics": (Topic("one", priority=12), Topic("two", priority=1))},
        {"topics": (Topic("one", priority=12),)},
        {"topics": (Topic("one", rate_limit_bytes_per_s=200_000), Topic("video", priority=14))},
        {"topics": (Topic("one"), Topic("two"))},
        {"fragment_bytes": 700},
        {"rates": Rates(ack_every_packets=4, heartbeat_s=0.5)},
        {"limits": Limits(events=1000)},
    ]
    for change in changes:
        for topic in ("one", "two"):
            result = world.send("a", topic, bytes(60_000), "b")
            sent += isinstance(result, int)
        world.run(0.05)
        assert world.nodes["a"].apply(replace(base, **change), world.now)  # type: ignore[arg-type]
    assert world.run(30.0, until=lambda: len(world.events_of("a", MessageDelivered)) == sent)
    assert len(world.events_of("b", MessageReceived)) == sent


def test_a_new_priority_reaches_messages_already_waiting() -> None:
    world = World()
    topics = (Topic("map", priority=5), Topic("video", priority=9))
    world.add(settings("a", *topics))
    world.add(settings("b", *topics))
    world.run(1.5)
    for name in ("map", "video"):
        for _ in range(3):
            world.send("a", name, bytes(300_000), "b")
    world.run(0.1)
    world.nodes["a"].apply(settings("a", Topic("map", priority=9), Topic("video", priority=5)), world.now)
    assert world.run(20.0, until=lambda: len(world.events_of("b", MessageReceived)) == 6)
    order = [event.topic for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert order[:3] == ["video"] * 3


def test_apply_lists_each_change() -> None:
    both = pair(Topic("map", priority=5))
    lines = both.a.apply(
        settings("a", Topic("map", priority=6), Topic("video"), window=3, rates=Rates(heartbeat_s=2.0)), both.now
    )
    assert lines == [
        "topic video: added",
        "topic map: priority 5 -> 6",
        "rates: heartbeat_s 1.0 -> 2.0",
        "window: adaptive -> 3",
    ]
    assert both.a.apply(both.a.settings, both.now) == []


def test_changes_are_described_with_configuration_keys_and_values() -> None:
    old, new = Topic("map"), Topic("map", outbox=Outbox.ALL, keep_last=3, destinations=("b", "c"), compression=True)
    both = pair(old, undeclared=None, neighbours=(Neighbour(("10.0.0.7", 8700)), Neighbour(("10.0.0.8", 8700))))
    settings_now = settings("a", new, undeclared=old, neighbours=(Neighbour(("10.0.0.7", 8700), "c"),))
    assert both.a.apply(settings_now, both.now) == [
        "topic map: keep_last none -> 3",
        "topic map: compression false -> true",
        "topic map: destinations [] -> [b, c]",
        "topic map: outbox none -> all",
        "undeclared: added",
        "neighbor 10.0.0.8: removed",
        "neighbor 10.0.0.7: name none -> c",
    ]
    later = settings("a", new, undeclared=replace(old, priority=3), neighbours=settings_now.neighbours)
    assert both.a.apply(later, both.now) == ["undeclared: priority 8 -> 3"]
    last = settings("a", new, undeclared=None, neighbours=later.neighbours)
    assert both.a.apply(last, both.now) == ["undeclared: removed"]


def test_an_undeclared_topic_is_refused_unless_all_are_allowed() -> None:
    both = pair()
    assert isinstance(both.a.send("new", b"x", destination="b", now=both.now), int)
    both.a.apply(replace(both.a.settings, undeclared=None), both.now)
    assert isinstance(both.a.send("newer", b"x", destination="b", now=both.now), Rejected)
    both.a.apply(replace(both.a.settings, topics=(Topic("newer"),)), both.now)
    assert isinstance(both.a.send("newer", b"x", destination="b", now=both.now), int)


def test_changing_the_node_name_requires_a_restart() -> None:
    both = pair()
    with pytest.raises(ValueError, match="restart the node"):
        both.a.apply(replace(both.a.settings, name="z"), both.now)


@pytest.mark.parametrize("window", [1, 3, 10])
def test_a_fixed_window_is_never_exceeded_by_bulk(window: int) -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, window=window))
    world.run(1.5)
    world.send("a", "any", bytes(200_000), "b")
    most = 0
    while not world.events_of("a", MessageDelivered):
        world.run(0.005)
        most = max(most, world.nodes["a"].conditions(world.now).peers[0].in_flight_packets)
    assert most == window


def test_a_rate_limit_is_enforced_without_delaying_other_topics() -> None:
    world = World()
    topics = (Topic("slow", priority=1, rate_limit_bytes_per_s=50_000), Topic("fast", priority=9))
    for name in ("a", "b"):
        world.add(settings(name, *topics))
    world.run(1.5)
    start = world.now
    slow = world.send("a", "slow", bytes(200_000), "b")
    fast = world.send("a", "fast", bytes(200_000), "b")
    ended: dict[int, float] = {}
    while len(ended) < 2:
        world.run(0.02)
        for event in world.events_of("a", MessageDelivered):
            assert isinstance(event, MessageDelivered)
            ended.setdefault(event.message_id, world.now - start)
    assert isinstance(slow, int)
    assert isinstance(fast, int)
    assert ended[MessageId(fast)] < 0.5
    assert 3.5 < ended[MessageId(slow)] < 5.0


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Settings(name="a"), "neither"),
        (lambda: Settings(name="a b", unkeyed=True), "white space"),
        (lambda: Settings(name="a/b", unkeyed=True), "slash"),
        (lambda: Settings(name="", unkeyed=True), "1 to 63"),
        (lambda: Settings(name="a", unkeyed=True, window=0), "window"),
        (lambda: Settings(name="a", unkeyed=True, topics=(Topic("t"), Topic("t"))), "twice"),
        (lambda: Topic("t", priority=16), "0 to 15"),
        (lambda: Topic("t", keep_last=0), "keep_last"),
        (lambda: Topic("t", deadline_s=0), "deadline_s"),
        (lambda: Rates(heartbeat_s=0), "heartbeat_s"),
        (lambda: Limits(peers=0), "limits.peers"),
    ],
)
def test_an_invalid_setting_error_states_what_was_expected(make: object, message: str) -> None:
    assert callable(make)
    with pytest.raises(ValueError, match=message):
        make()
