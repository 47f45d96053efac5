"""The peer's state: one table, total, and followed by a peer that comes, goes silent and returns."""

import itertools

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.peers.peer_state import TRANSITIONS, PeerEvent, PeerState


def test_every_event_is_defined_in_every_state() -> None:
    assert set(TRANSITIONS) == set(itertools.product(PeerState, PeerEvent))


@pytest.mark.parametrize("state", PeerState)
def test_only_the_heard_event_brings_a_peer_online(state: PeerState) -> None:
    assert TRANSITIONS[state, PeerEvent.HEARD] is PeerState.ONLINE
    others = {TRANSITIONS[state, event] for event in PeerEvent if event is not PeerEvent.HEARD}
    assert (PeerState.ONLINE in others) == (state is PeerState.ONLINE)


def test_a_peer_is_lost_only_after_it_was_offline() -> None:
    becoming_lost = {state for (state, _), result in TRANSITIONS.items() if result is PeerState.LOST}
    assert becoming_lost == {PeerState.LOST, PeerState.OFFLINE}


def test_a_peer_goes_online_offline_lost_and_online_again() -> None:
    world = World()
    for name in "ab":
        world.add(settings(name))
    world.run(3.0)

    def state() -> PeerState:
        return world.nodes["a"]._state.peer_table.peers["b"].state

    seen = [state()]
    world.pipes[("b", "a")].up = False
    for _ in range(80):
        world.run(1.0)
        if seen[-1] is not state():
            seen.append(state())
    assert seen == [PeerState.ONLINE, PeerState.OFFLINE, PeerState.LOST]
    world.pipes[("b", "a")].up = True
    world.run(10.0)
    assert state() is PeerState.ONLINE
