"""Whole teams on the simulated channel: nothing accepted is lost silently, whatever happens to links and nodes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from udp_mesh.core.events import MessageDelivered, MessageExpired, MessagePeerLost, MessageReceived, Rejected
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.sim.command import find
from udp_mesh.sim.medium import RadioChannel
from udp_mesh.sim.run import RunResult, play
from udp_mesh.sim.scenario import load
from udp_mesh.sim.team import Team

TOPICS = (Topic("estop", priority=0), Topic("map", priority=8))


def team(names: str, loss: float = 0.1, **channel: float) -> Team:
    settings = {name: Settings(name, unkeyed=True, topics=TOPICS) for name in names}
    return Team(settings, channel=RadioChannel(**channel), loss=lambda a, b, now: loss, seed=1)  # type: ignore[arg-type]


def accounted(played: RunResult) -> None:
    assert played.ledger.ended_twice == [], f"seed {played.scenario.seed}"


def test_every_reliable_message_is_delivered_once_while_the_link_is_up() -> None:
    made = team("ab")
    made.event_queue.run_until(5.0)
    sent = [made.send("a", "map", bytes([number]) * 20_000, "b") for number in range(20)]
    made.event_queue.run_until(60.0)
    assert not any(isinstance(one, Rejected) for one in sent)
    assert made.ledger.total(MessageDelivered) == 20
    assert made.ledger.ended_twice == []


def test_an_urgent_message_overtakes_a_map_under_way() -> None:
    arrivals: list[str] = []
    settings = {name: Settings(name, unkeyed=True, topics=TOPICS) for name in "ab"}

    def note(now: float, robot: str, event: object) -> None:
        topic = getattr(event, "topic", None)
        if robot == "b" and topic is not None:
            arrivals.append(topic)

    made = Team(settings, channel=RadioChannel(rate=2e6), loss=lambda a, b, now: 0.0, seed=1, on_event=note)
    made.event_queue.run_until(5.0)
    made.send("a", "map", bytes(2_000_000), "b")
    made.event_queue.run_until(7.0)
    made.send("a", "estop", b"stop", "b")
    made.event_queue.run_until(30.0)
    assert arrivals == ["estop", "map"]


def test_a_repaired_broadcast_reaches_all_exactly_once() -> None:
    arrivals: list[tuple[str, bytes]] = []
    topics = (Topic("estop", priority=0, repair=True, deadline_s=10),)

    def note(now: float, robot: str, event: object) -> None:
        if isinstance(event, MessageReceived):
            arrivals.append((robot, event.payload))

    made = Team(
        {name: Settings(name, unkeyed=True, topics=topics) for name in "abcd"},
        channel=RadioChannel(), loss=lambda a, b, now: 0.3, seed=3, on_event=note,
    )  # fmt: skip
    made.event_queue.run_until(5.0)
    for number in range(20):
        made.send("a", "estop", bytes([number]))
        made.event_queue.run_until(5.0 * (number + 2))
    made.event_queue.run_until(130.0)
    assert sorted(arrivals) == sorted((robot, bytes([number])) for robot in "bcd" for number in range(20))


def test_a_crash_in_the_middle_of_a_transfer_is_survived() -> None:
    made = team("ab", rate=2e6)
    made.event_queue.run_until(5.0)
    made.send("a", "map", bytes(1_000_000), "b")
    made.event_queue.run_until(6.0)
    made.crash("b")
    made.event_queue.run_until(8.0)
    made.restart("b", Settings("b", unkeyed=True, topics=TOPICS))
    made.event_queue.run_until(40.0)
    assert made.ledger.total(MessageDelivered) == 1
    assert made.ledger.ended_twice == []


def test_an_address_change_loses_no_accepted_message() -> None:
    made = team("ab", rate=2e6)
    made.event_queue.run_until(5.0)
    made.send("a", "map", bytes(500_000), "b")
    made.event_queue.run_until(5.5)
    made.change_address("b", "10.0.77.7")
    made.event_queue.run_until(40.0)
    assert made.ledger.total(MessageDelivered) == 1


@pytest.mark.parametrize("seed", [1, 2])
def test_a_soak_with_partitions_and_restarts_accounts_for_every_message(seed: int) -> None:
    scenario = replace(load(find("partition-soak")), seed=seed, duration_s=900.0)
    played = play(scenario)
    accounted(played)
    # Every accepted message has an outcome, waits in an outbox, or is in flight at the end.
    ended = sum(played.ledger.total(kind) for kind in (MessageDelivered, MessageExpired, MessagePeerLost))
    assert 0 < ended <= played.ledger.accepted
    assert played.topics["report"].messages > 0


def test_the_same_seed_gives_the_same_recording() -> None:
    scenario = replace(load(find("partition-soak")), duration_s=60.0)
    assert play(scenario).lines == play(scenario).lines


@pytest.mark.proof
@pytest.mark.parametrize("seed", range(10))
def test_no_message_ends_twice_in_hours_of_partitions_and_restarts(seed: int) -> None:
    accounted(play(replace(load(find("partition-soak")), seed=seed)))
