"""What is proven about a session, and whether its peer hears us: two tables, and nodes that follow them."""

import itertools

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.peers.session import Session
from udp_mesh.core.peers.session_state import (
    RECEPTION_TRANSITIONS,
    SESSION_TRANSITIONS,
    Reception,
    ReceptionEvent,
    SessionEvent,
    SessionState,
)


def test_every_reception_event_is_defined_in_every_state() -> None:
    assert set(RECEPTION_TRANSITIONS) == set(itertools.product(Reception, ReceptionEvent))


@pytest.mark.parametrize("state", Reception)
def test_only_a_peer_that_stops_listing_us_becomes_one_way(state: Reception) -> None:
    becomes_one_way = {event for event in ReceptionEvent if RECEPTION_TRANSITIONS[state, event] is Reception.ONE_WAY}
    kept = {ReceptionEvent.NOT_LISTED, ReceptionEvent.ACKNOWLEDGED}
    expected = {Reception.LISTS_US: {ReceptionEvent.NOT_LISTED}, Reception.ONE_WAY: kept}
    assert becomes_one_way == expected.get(state, set())


def test_a_peer_that_once_heard_us_never_becomes_unknown() -> None:
    assert {state for (state, _), result in RECEPTION_TRANSITIONS.items() if result is Reception.UNKNOWN} == {
        Reception.UNKNOWN
    }


def test_every_unverified_session_state_can_become_verified() -> None:
    verified = {state for (state, event) in SESSION_TRANSITIONS if event is SessionEvent.VERIFIED}
    assert verified == set(SessionState) - {SessionState.VERIFIED}
    assert all(SESSION_TRANSITIONS[state, SessionEvent.VERIFIED] is SessionState.VERIFIED for state in verified)


def test_a_session_becomes_one_way_when_the_peer_no_longer_hears_us() -> None:
    world = World()
    for name in "ab":
        world.add(settings(name))
    world.run(3.0)

    def session() -> Session:
        (found,) = world.nodes["a"]._state.peer_table.sessions.values()
        return found

    assert (session().state, session().reception) == (SessionState.VERIFIED, Reception.LISTS_US)
    assert session().one_way_since is None
    world.pipes[("a", "b")].up = False
    lost_at = world.now
    # b's heartbeats list a until b has not heard it for a few intervals
    world.run(8.0)
    assert session().reception is Reception.ONE_WAY
    since = session().one_way_since
    assert since is not None
    assert lost_at < since < world.now
    world.pipes[("a", "b")].up = True
    world.run(3.0)
    assert session().reception is Reception.LISTS_US
    assert session().one_way_since is None
