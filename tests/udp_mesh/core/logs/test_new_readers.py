"""A node that only carried a log's items, and then becomes a reader of it."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.logs.team import LogTeam
from tests.udp_mesh.core.pair import settings
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.settings import Log, Topic

BASE_ONLY = Topic("artifact", priority=4, log=Log(readers=("base",)))
BOTH = Topic("artifact", priority=4, log=Log(readers=("base", "husky")))


def make_reader(team: LogTeam, name: str, *, restarts: bool, confirms: bool = False) -> None:
    """Everybody is configured with the new reader."""
    team.topics = (BOTH,)
    for other in team.nodes:
        if other != name:
            team.nodes[other].apply(settings(other, BOTH), team.now)
    if restarts:
        team.stop(name)
        team.start(name, confirms=confirms)
        team.separate()
    else:
        team.nodes[name].apply(settings(name, BOTH, confirms=confirms), team.now)
    team.run(1)


@pytest.mark.parametrize("restarts", [False, True])
def test_a_carrier_that_becomes_a_reader_delivers_what_it_carried_once(restarts: bool) -> None:
    team = LogTeam("base", "husky", "spot", topics=[BASE_ONLY])
    message = team.publish("spot", b"one")
    team.publish("spot", b"two")
    team.meet("spot", "husky", seconds=4)
    assert team.read("husky") == []
    make_reader(team, "husky", restarts=restarts)
    assert sorted(team.read("husky")) == [("spot", 1, b"one"), ("spot", 2, b"two")]
    # The source learns of it, and it is not repeated by a change back and forth or a restart.
    team.meet("spot", "husky", seconds=4)
    delivered = [event for event in team.events_of("spot", MessageDelivered) if isinstance(event, MessageDelivered)]
    assert (message, "husky") in [(event.message_id, event.peer) for event in delivered]
    for topic in (BASE_ONLY, BOTH):
        team.nodes["husky"].apply(settings("husky", topic), team.now)
    team.stop("husky")
    team.start("husky")
    team.run(2)
    assert len(team.read("husky")) == 2
    team.meet("husky", "base", seconds=4)
    assert len(team.read("base")) == 2


def test_a_new_reader_that_did_not_take_the_items_gets_them_after_a_restart() -> None:
    team = LogTeam("base", "husky", "spot", topics=[BASE_ONLY])
    team.publish("spot", b"one")
    team.meet("spot", "husky", seconds=4)
    for _ in range(2):
        make_reader(team, "husky", restarts=True, confirms=True)
    # No program confirmed it, so it is delivered by each run.
    assert team.read("husky") == [("spot", 1, b"one")] * 2


@pytest.mark.parametrize("restarts", [False, True])
def test_a_new_reader_requests_again_what_it_carried_and_dropped(restarts: bool) -> None:
    small = Topic("artifact", priority=4, log=Log(readers=("base",), max_age_s=30.0))
    team = LogTeam("base", "husky", "spot", topics=[BASE_ONLY])
    team.nodes["husky"].apply(settings("husky", small), team.now)
    team.publish("spot", b"one")
    team.meet("spot", "husky", seconds=4, apart_s=40)
    assert team.stores["husky"].items == {}
    make_reader(team, "husky", restarts=restarts)
    assert team.read("husky") == []
    team.meet("spot", "husky", seconds=4)
    assert team.read("husky") == [("spot", 1, b"one")]


def test_a_reader_that_becomes_a_carrier_keeps_what_its_programs_wait_for() -> None:
    team = LogTeam("base", "husky", "spot", topics=[BOTH])
    team.stop("husky")
    team.start("husky", confirms=True)
    team.separate()
    team.publish("spot", b"one")
    team.meet("spot", "husky", seconds=4)
    assert len(team.read("husky")) == 1
    team.topics = (BASE_ONLY,)
    team.stop("husky")
    team.start("husky", confirms=True)
    team.separate()
    team.run(1)
    assert len(team.read("husky")) == 2
