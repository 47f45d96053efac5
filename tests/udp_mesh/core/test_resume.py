"""A message returned to an outbox while being sent keeps its number: a peer that had all of it does not deliver it
twice."""

from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import BROADCAST, World, settings
from udp_mesh.core.events import MessageDelivered, MessageExpired, MessageReceived, PeerOffline, PeerOnline
from udp_mesh.core.settings import Limits, LinkInfo, LinkKind, Outbox, Topic

ART = Topic("art", outbox=Outbox.ALL)


def met(*topics: Topic, **changes: object) -> World:
    world = World(seed=1)
    for name in ("a", "b"):
        world.add(settings(name, *topics, **changes))
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))
    return world


def cut(world: World, *paths: tuple[str, str]) -> None:
    for path in paths:
        world.pipes[path].up = False


def heal(world: World) -> None:
    for path in world.pipes.values():
        path.up = True
    assert world.run(20.0, until=lambda: all(peer.online for peer in world.nodes["a"].conditions(world.now).peers))


@examples(max_examples=15)
@given(st.integers(1, 60_000), st.floats(0.0, 0.08))
def test_an_outage_at_any_moment_still_delivers_a_message_once(size_bytes: int, after_s: float) -> None:
    world = met(ART)
    world.send("a", "art", bytes(size_bytes), "b")
    world.run(after_s)
    # What was sent arrives but is no longer acknowledged.
    cut(world, ("b", "a"))
    world.run(0.02)
    cut(world, ("a", "b"))
    assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    heal(world)
    assert world.run(10.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    world.run(3.0)
    assert len(world.events_of("a", MessageDelivered)) == 1
    assert len(world.events_of("b", MessageReceived)) == 1


def test_received_fragments_of_a_large_message_are_not_resent() -> None:
    world = met(ART)
    world.send("a", "art", bytes(2_000_000), "b")
    world.run(1.0)
    cut(world, *world.pipes)
    assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    heal(world)
    assert world.run(10.0, until=lambda: bool(world.events_of("b", MessageReceived)))
    assert (
        world.pipes[("a", "b")].carried_bytes < 2_700_000
    )  # with the probes of ten seconds; all of it again would be 3.2 MB


def test_a_fully_sent_message_arrives_once_after_the_link_mtu_shrinks() -> None:
    world = met(ART)
    cut(world, ("b", "a"))
    world.send("a", "art", bytes(4_000), "b")
    assert world.run(1.0, until=lambda: bool(world.events_of("b", MessageReceived)))
    cut(world, *world.pipes)
    assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    link = LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST, mtu=700)
    world.nodes["a"].link_up(link, world.now)
    heal(world)
    assert world.run(10.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    assert len(world.events_of("b", MessageReceived)) == 1


def test_a_peer_that_restarted_gets_the_message_again() -> None:
    world = met(ART)
    world.send("a", "art", bytes(500_000), "b")
    world.run(0.2)
    cut(world, *world.pipes)
    assert world.run(30.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    world.add(settings("b", ART))
    heal(world)
    assert world.run(
        10.0, until=lambda: bool(world.events_of("b", MessageReceived) and world.events_of("a", MessageDelivered))
    )
    assert len(world.events_of("b", MessageReceived)) == 1


def test_a_peer_that_lost_its_fragments_meanwhile_gets_the_message_again() -> None:
    world = met(ART)
    world.send("a", "art", bytes(500_000), "b")
    world.run(0.2)
    cut(world, *world.pipes)
    world.run(400.0)
    heal(world)
    assert world.run(
        10.0, until=lambda: bool(world.events_of("b", MessageReceived) and world.events_of("a", MessageDelivered))
    )
    assert len(world.events_of("b", MessageReceived)) == 1


def test_a_message_expired_in_the_outbox_frees_its_fragments_at_the_peer() -> None:
    world = met(Topic("art", outbox=Outbox.ALL, deadline_s=40.0), limits=Limits())
    world.send("a", "art", bytes(500_000), "b")
    world.run(0.2)
    cut(world, *world.pipes)
    world.run(60.0)
    assert len(world.events_of("a", MessageExpired)) == 1
    assert world.nodes["b"].conditions(world.now).partial_bytes > 0
    heal(world)
    assert world.run(5.0, until=lambda: world.nodes["b"].conditions(world.now).partial_bytes == 0)
    assert not world.events_of("b", MessageReceived)
