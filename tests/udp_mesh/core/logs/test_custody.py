"""Items reach readers that never meet their source, once, through nodes that meet both."""

from __future__ import annotations

from tests.udp_mesh.core.logs.team import LogTeam
from udp_mesh.core.events import LogItemHeld, MessageDelivered, MessageReceived
from udp_mesh.core.settings import Log, Topic


def test_an_item_reaches_a_reader_that_never_meets_its_source() -> None:
    team = LogTeam("base", "husky", "spot")
    sent = [team.publish("spot", b"artifact %d" % number * 500) for number in range(20)]
    team.meet("spot", "husky", seconds=5)
    team.meet("husky", "base", seconds=5)
    assert sorted(team.read("base")) == [("spot", number + 1, b"artifact %d" % number * 500) for number in range(20)]
    assert team.read("husky") == []
    assert len(sent) == 20


def test_the_source_learns_who_carries_and_who_has_read() -> None:
    team = LogTeam("base", "husky", "spot")
    message = team.publish("spot", b"backpack")
    team.meet("spot", "husky", seconds=5)
    assert team.events_of("spot", LogItemHeld) == [LogItemHeld(message, "husky", "artifact", 1)]
    team.meet("husky", "base", seconds=5)
    assert team.events_of("spot", MessageDelivered) == []
    team.meet("spot", "husky", seconds=5)
    delivered = team.events_of("spot", MessageDelivered)
    assert [(event.message_id, event.peer) for event in delivered if isinstance(event, MessageDelivered)] == [
        (message, "base")
    ]
    assert team.nodes["spot"].logs()[0].missing_readers == ()


def test_two_carriers_bring_an_item_once() -> None:
    team = LogTeam("base", "husky", "drone", "spot")
    team.publish("spot", b"survivor" * 1000)
    team.meet("spot", "husky", seconds=5)
    team.meet("spot", "drone", seconds=5)
    team.meet("husky", "base", seconds=5)
    team.meet("drone", "base", seconds=5)
    team.meet("husky", "drone", "base", seconds=5)
    assert team.read("base") == [("spot", 1, b"survivor" * 1000)]


def test_a_carrier_leaves_items_to_a_reader_in_reach() -> None:
    team = LogTeam("base", "husky", "spot")
    team.connect("base", "husky", "spot")
    team.run(3)
    for number in range(10):
        team.publish("spot", b"%d" % number * 100)
        team.run(1)
    assert len(team.read("base")) == 10
    assert team.stores["husky"].items == {}


def test_an_item_reaches_every_node_of_a_log_without_named_readers() -> None:
    team = LogTeam("base", "husky", "spot", topics=[Topic("shared", log=Log())])
    team.publish("spot", b"one", "shared")
    team.publish("base", b"two", "shared")
    team.meet("spot", "husky", seconds=5)
    team.meet("husky", "base", seconds=5)
    team.meet("husky", "spot", seconds=5)
    assert team.read("husky", "shared") == [("spot", 1, b"one"), ("base", 1, b"two")]
    assert team.read("base", "shared") == [("spot", 1, b"one")]
    assert team.read("spot", "shared") == [("base", 1, b"two")]


def test_a_node_that_restarts_keeps_its_items_and_numbers() -> None:
    team = LogTeam("base", "husky", "spot")
    team.publish("spot", b"before")
    team.meet("spot", "husky", seconds=5)
    for name in ("spot", "husky"):
        team.stop(name)
        team.start(name)
    team.separate()
    team.publish("spot", b"after")
    team.meet("spot", "husky", seconds=5)
    team.meet("husky", "base", seconds=5)
    assert team.read("base") == [("spot", 1, b"before"), ("spot", 2, b"after")]


def test_an_item_that_no_program_took_is_delivered_after_a_restart() -> None:
    team = LogTeam("base", "spot")
    team.stop("base")
    team.start("base", confirms=True)
    team.separate()
    team.publish("spot", b"artifact")
    team.meet("spot", "base", seconds=5)
    assert len(team.read("base")) == 1
    team.stop("base")
    team.start("base", confirms=True)
    team.separate()
    team.run(1)
    received = [event for event in team.events_of("base", MessageReceived) if isinstance(event, MessageReceived)]
    assert len(received) == 2
    assert received[1].receipt is not None
    team.nodes["base"].confirm(received[1].receipt)
    team.stop("base")
    team.start("base", confirms=True)
    team.run(1)
    assert len(team.read("base")) == 2


def test_the_base_asks_only_for_what_it_lacks() -> None:
    team = LogTeam("base", "husky", "spot")
    for number in range(50):
        team.publish("spot", b"%d" % number * 2000)
    team.meet("spot", "husky", seconds=5)
    team.meet("husky", "base", seconds=5)
    carried = sum(pipe.carried_bytes for pipe in team.pipes.values())
    team.meet("husky", "base", seconds=5)
    assert sum(pipe.carried_bytes for pipe in team.pipes.values()) - carried < 20_000
    assert len(team.read("base")) == 50
