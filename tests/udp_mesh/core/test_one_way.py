"""A link that works in one direction only: an unreachable peer is never online, and every message ends."""

from tests.udp_mesh.core.pair import BROADCAST, World, settings
from udp_mesh.core.events import (
    MessageDelivered,
    MessagePeerLost,
    MessageReceived,
    PeerOffline,
    PeerOnline,
)
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import Outbox, Topic

TOPICS = (Topic("map"), Topic("art", outbox=Outbox.ALL))


def met(seed: int) -> World:
    world = World(seed=seed)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    world.run(3.0)
    return world


def peer(world: World, name: str) -> tuple[bool, bool]:
    """(online, one way) of a node's only peer."""
    (found,) = world.nodes[name].conditions(world.now).peers
    return found.online, found.one_way


def test_a_peer_that_cannot_hear_us_goes_offline_and_returns() -> None:
    world = met(1)
    world.pipes[("a", "b")].up = False
    world.send("a", "map", bytes(5000), "b")
    world.send("a", "art", b"found", "b")
    assert world.run(20.0, until=lambda: peer(world, "a") == (True, True))
    assert world.run(20.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    assert peer(world, "a") == (False, True)
    assert world.events_of("b", PeerOffline)
    world.run(10.0)
    assert len(world.events_of("a", PeerOnline)) == 1
    # Meanwhile b's messages are accepted: that direction works.
    world.send("b", "map", b"one way", "a")
    world.pipes[("a", "b")].up = True
    assert world.run(10.0, until=lambda: len(world.events_of("a", PeerOnline)) == 2)
    assert world.run(5.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 2)
    assert peer(world, "a") == (True, False)
    assert len(world.events_of("b", MessageReceived)) == 2


def carry_broadcasts_alone(world: World, source: str, target: str) -> None:
    """As behind a firewall that blocks unicast in this direction."""
    to_one = False

    def look(name: str, datagram: Datagram, now: float) -> None:
        nonlocal to_one
        to_one = datagram.destination not in (None, BROADCAST)

    world.tap = look
    world.pipes[(source, target)].lost = lambda rng, now: to_one


def test_a_peer_that_receives_only_our_broadcasts_is_reported_as_not_answering() -> None:
    world = met(5)
    (before,) = world.nodes["a"].conditions(world.now).peers
    assert before.unanswered_for_s is None
    carry_broadcasts_alone(world, "a", "b")
    started = world.now
    world.send("a", "map", bytes(5000), "b")
    world.run(20.0)
    (found,) = world.nodes["a"].conditions(world.now).peers
    assert (found.online, found.one_way) == (True, False)
    assert found.unanswered_for_s is not None
    assert world.now - started - 2.0 < found.unanswered_for_s <= world.now - started + 2.0


def test_messages_without_an_outbox_to_a_peer_lost_for_good_end_as_peer_lost() -> None:
    world = met(2)
    world.pipes[("a", "b")].up = False
    world.send("a", "map", bytes(5000), "b")
    assert world.run(120.0, until=lambda: bool(world.events_of("a", MessagePeerLost)))
    assert len(world.events_of("a", MessagePeerLost)) == 1
    assert not world.events_of("a", MessageDelivered)


def test_a_node_that_never_heard_us_is_reported_as_unverified_and_not_as_a_peer() -> None:
    world = World(seed=3)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    world.pipes[("a", "b")].up = False
    world.run(10.0)
    conditions = world.nodes["a"].conditions(world.now)
    assert not conditions.peers
    assert [(stranger.name, stranger.address) for stranger in conditions.strangers] == [("b", ("10.0.0.2", 8700))]
    assert not world.nodes["b"].conditions(world.now).strangers
    world.pipes[("a", "b")].up = True
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    assert not world.nodes["a"].conditions(world.now).strangers


def test_fifty_percent_loss_takes_no_peer_offline() -> None:
    world = met(4)
    for path in world.pipes.values():
        path.loss = 0.5
    world.run(300.0)
    assert not world.events_of("a", PeerOffline)
    assert not world.events_of("b", PeerOffline)
