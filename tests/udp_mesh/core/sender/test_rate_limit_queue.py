"""A long queue behind a topic's rate limit costs no more than a short one, and keeps its order."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.sender.scheduler import Run, Scheduler
from udp_mesh.core.settings import Topic

LIMITED = Topic("limited", priority=7, rate_limit_bytes_per_s=10_000)


def world(*names: str) -> World:
    """Nodes that have met."""
    team = World(seed=3)
    for name in names:
        team.add(settings(name, LIMITED))
    team.run(3.0)
    return team


def publish(team: World, destination: str, *numbers: int) -> None:
    for number in numbers:
        team.send("a", "limited", b"%4d" % number + bytes(200), destination=destination)


def received(team: World, name: str) -> list[int]:
    events = team.events_of(name, MessageReceived)
    return [int(event.payload[:4]) for event in events if isinstance(event, MessageReceived)]


@pytest.mark.parametrize("waiting", [50, 1000])
def test_each_message_is_parked_a_few_times_however_many_wait(waiting: int, monkeypatch: pytest.MonkeyPatch) -> None:
    parked = 0
    park_head = Scheduler.park_head

    def counting(scheduler: Scheduler, run: Run) -> None:
        nonlocal parked
        parked += 1
        park_head(scheduler, run)

    monkeypatch.setattr(Scheduler, "park_head", counting)
    team = world("a", "b")
    publish(team, "b", *range(waiting))
    before = parked
    team.run(1.0)
    sent = len(received(team, "b"))
    assert 30 <= sent <= 50
    assert parked - before <= waiting + 2 * sent


def test_later_messages_do_not_overtake_those_that_wait() -> None:
    team = world("a", "b")
    for number in range(0, 300, 3):
        publish(team, "b", number, number + 1, number + 2)
        team.run(0.02)
    team.run(10.0)
    assert received(team, "b") == list(range(300))


def test_lost_messages_and_those_that_wait_all_arrive() -> None:
    team = world("a", "b")
    for pipe in team.pipes.values():
        pipe.loss = 0.2
    for number in range(200):
        publish(team, "b", number)
        team.run(0.02)
    team.run(20.0)
    assert sorted(received(team, "b")) == list(range(200))


def test_peers_share_the_limit_and_one_that_is_gone_takes_nothing_of_it() -> None:
    team = world("a", "b", "c", "d")
    team.pipes["a", "d"].up = team.pipes["d", "a"].up = False
    for number in range(200):
        for peer in "bcd":
            publish(team, peer, number)
    team.run(4.0)
    counts = Counter({name: len(received(team, name)) for name in "bcd"})
    assert counts["d"] == 0
    assert abs(counts["b"] - counts["c"]) <= 2
    assert counts.total() >= 100
    assert [received(team, name) for name in "bc"] == [list(range(counts[name])) for name in "bc"]


def test_the_limit_of_undeclared_topics_outlasts_a_reload() -> None:
    team = World(seed=3)
    for name in "ab":
        team.add(replace(settings(name), undeclared=replace(LIMITED, name="undeclared")))
    team.run(3.0)
    publish(team, "b", *range(200))
    node = team.nodes["a"]
    node.apply(replace(node.settings, topics=(Topic("other"),)), team.now)
    team.run(1.0)
    assert len(received(team, "b")) <= 60
