"""A suspended process or machine (stopped, swapped out, a paused virtual machine) causes no loss."""

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessagePeerLost, MessageReceived, PeerOffline, PeerOnline
from udp_mesh.core.settings import Topic

TOPICS = (Topic("map", priority=7), Topic("status", priority=0))
MAP_BYTES = 1_000_000


def met(seed: int) -> World:
    world = World(seed=seed)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    return world


def delivered_once(world: World, within_s: float) -> None:
    assert world.run(within_s, until=lambda: bool(world.events_of("a", MessageDelivered)))
    world.run(5.0)
    assert len(world.events_of("a", MessageDelivered)) == 1
    assert len(world.events_of("b", MessageReceived)) == 1
    assert not world.events_of("a", MessagePeerLost)


@pytest.mark.parametrize("stopped_s", [2.0, 20.0, 120.0, 1000.0])
@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_suspended_team_resumes_its_transfer(stopped_s: float, lost: bool, seed: int) -> None:
    world = met(seed)
    world.send("a", "map", bytes(MAP_BYTES), "b")
    world.run(0.3)
    world.now += stopped_s
    if lost:
        world._queue.clear()
    delivered_once(world, within_s=3.0)
    assert not world.events_of("a", PeerOffline)
    assert not world.events_of("b", PeerOffline)


def stop(world: World, name: str, stopped_s: float) -> None:
    """Suspend one node and lose what is sent to it meanwhile; then resume it."""
    stopped = world.nodes.pop(name)
    world.run(stopped_s)
    world.nodes[name] = stopped


@pytest.mark.parametrize("stopped_s", [5.0, 45.0, 200.0])
def test_a_suspended_sender_declares_no_peer_lost(stopped_s: float) -> None:
    """What the others sent meanwhile did not fit the socket's buffer: to the sender they were silent."""
    world = met(3)
    world.send("a", "map", bytes(MAP_BYTES), "b")
    world.run(0.3)
    stop(world, "a", stopped_s)
    delivered_once(world, within_s=6.0)
    assert not world.events_of("a", PeerOffline)
    assert bool(world.events_of("b", PeerOffline)) == (stopped_s > 10)


@pytest.mark.parametrize("stopped_s", [5.0, 45.0])
def test_a_suspended_receiver_gets_the_message_after_resuming(stopped_s: float) -> None:
    world = met(4)
    world.send("a", "map", bytes(MAP_BYTES), "b")
    world.run(0.3)
    stop(world, "b", stopped_s)
    delivered_once(world, within_s=6.0)
    assert not world.events_of("b", PeerOffline)
    assert bool(world.events_of("a", PeerOffline)) == (stopped_s > 10)


def test_a_peer_silent_after_a_suspension_is_still_declared_lost() -> None:
    world = met(5)
    world.send("a", "map", bytes(MAP_BYTES), "b")
    del world.nodes["b"]
    world.now += 500.0
    world.run(9.0)
    assert not world.events_of("a", PeerOffline)
    assert world.run(3.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    assert world.run(60.0, until=lambda: bool(world.events_of("a", MessagePeerLost)))
