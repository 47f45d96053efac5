"""The sender's state: one table, total, and followed by a sender whose peer falls silent and answers again."""

import itertools

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.sender.send_state import TRANSITIONS, SendEvent, SendState
from udp_mesh.core.settings import Topic


def test_every_event_is_defined_in_every_state() -> None:
    assert set(TRANSITIONS) == set(itertools.product(SendState, SendEvent))


@pytest.mark.parametrize("state", SendState)
def test_an_acknowledgement_or_a_restart_always_makes_the_sender_active(state: SendState) -> None:
    assert TRANSITIONS[state, SendEvent.ACKNOWLEDGED] is SendState.ACTIVE
    assert TRANSITIONS[state, SendEvent.RESTARTED] is SendState.ACTIVE


def test_an_unresponsive_sender_stays_so_until_the_peer_answers_or_restarts() -> None:
    leaving = {event for event in SendEvent if TRANSITIONS[SendState.UNRESPONSIVE, event] is not SendState.UNRESPONSIVE}
    assert leaving == {SendEvent.ACKNOWLEDGED, SendEvent.RESTARTED}


def test_a_sender_times_out_becomes_unresponsive_and_active_again() -> None:
    both = pair(Topic("map"))
    both.a.send("map", b"before", destination="b", now=both.now)
    both.roundtrip(times=10)
    sender = both.a._state.peer_table.peers["b"].open_sender()
    assert sender.state is SendState.ACTIVE
    both.a.send("map", b"lost", destination="b", now=both.now)
    seen: list[SendState] = []
    for _ in range(200):
        both.drop(both.a)
        if not seen or seen[-1] is not sender.state:
            seen.append(sender.state)
        both.now += 0.01
    assert seen == [SendState.ACTIVE, SendState.TIMING_OUT, SendState.UNRESPONSIVE]
    both.roundtrip(times=50)
    assert sender.state is SendState.ACTIVE
