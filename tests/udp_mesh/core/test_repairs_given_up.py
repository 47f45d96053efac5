"""A repair that cannot arrive is given up: it is more urgent than most messages, which would wait for it forever."""

from __future__ import annotations

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.path_mtu import refragment
from udp_mesh.core.peers.session import Peer
from udp_mesh.core.settings import Topic
from udp_mesh.wire.frames import RefuseReason

NEWS = Topic("news", priority=1, repair=True)


def missing_at_b() -> World:
    """a has a broadcast that b lacks and asks for."""
    world = World(seed=4)
    for name in "ab":
        world.add(settings(name, NEWS))
    world.run(2.0)
    world.pipes["a", "b"].loss = 1.0
    world.send("a", "news", bytes(1380))
    world.run(0.1)
    return world


def peer_of(world: World, name: str, other: str) -> Peer:
    return world.nodes[name]._state.peer_table.peers[other]


def test_a_repair_that_its_receiver_refuses_is_given_up() -> None:
    world = missing_at_b()
    session = peer_of(world, "b", "a").session
    assert session is not None
    session.receiver._refuse_for_good((True, 0), RefuseReason.CORRUPT)
    world.pipes["a", "b"].loss = 0.0
    world.run(10.0)
    assert world.nodes["b"].conditions(world.now).counters.repairs_asked > 0
    assert not peer_of(world, "a", "b").open_sender().pending
    world.send("a", "any", b"x", "b")
    world.run(1.0)
    assert len(world.events_of("a", MessageDelivered)) == 1


def test_a_repair_is_given_up_when_its_fragments_become_too_large() -> None:
    world = missing_at_b()
    # The heartbeat arrives, the repair does not.
    world.pipes["a", "b"].lost = lambda _, now: world.nodes["b"].conditions(now).counters.repairs_asked > 0
    sender = peer_of(world, "a", "b").open_sender()
    assert world.run(5.0, until=lambda: any(message.next_position for message in sender.pending))
    session = peer_of(world, "a", "b").session
    assert session is not None
    session.path.switch_to(session.path.link, session.path.address, 576, 1400)
    refragment(sender, session.path, include_sent=True)
    assert not sender.pending
