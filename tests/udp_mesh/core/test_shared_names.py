"""Two nodes with one name: reported, one of them served, and the other again as soon as that one is gone."""

import pytest

from tests.udp_mesh.core.pair import BROADCAST, Pipe, World, settings
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    MessageDelivered,
    MessagePeerLost,
    MessageReceived,
    NameConflict,
    PeerOffline,
    PeerOnline,
)
from udp_mesh.core.peer_lifecycle import REPORT_INTERVAL_S
from udp_mesh.core.settings import LinkInfo, LinkKind, Topic

MAP = Topic("map", priority=7)


def conflict() -> World:
    """The nodes are called "a" and "a2" here; both have the name a."""
    world = World(seed=1)
    for name in ("a", "c"):
        world.add(settings(name, MAP))
    assert world.run(5.0, until=lambda: bool(world.events_of("c", PeerOnline)))
    exchange(world, "a")
    second = Endpoint(settings("a", MAP), boot_id=world.rng.randbytes(16), rng=world.rng, now=world.now)
    world.nodes["a2"], world.addresses["a2"], world.events["a2"] = second, ("10.0.0.9", 8700), []
    second.link_up(LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a2"], BROADCAST), world.now)
    for other in ("a", "c"):
        world.pipes["a2", other] = Pipe()
        world.pipes[other, "a2"] = Pipe()
    for name in ("a", "a2", "c"):
        assert world.run(10.0, until=lambda: bool(world.events_of(name, NameConflict)))  # noqa: B023
    exchange(world, "a2")
    return world


def exchange(world: World, name: str) -> None:
    """One message each way between c and the node that c knows as a."""
    before = {who: len(world.events_of(who, MessageReceived)) for who in ("c", name)}
    ended = {who: len(world.events_of(who, MessageDelivered)) for who in ("c", name)}
    world.send(name, "map", bytes(20_000), "c")
    world.send("c", "map", bytes(20_000), "a")
    world.run(2.0)
    for who in ("c", name):
        assert len(world.events_of(who, MessageReceived)) == before[who] + 1
        assert len(world.events_of(who, MessageDelivered)) == ended[who] + 1


def test_a_lasting_name_conflict_is_reported_once_a_minute_despite_new_boot_ids() -> None:
    world = conflict()
    for number in range(20):
        again = Endpoint(settings("a", MAP), boot_id=world.rng.randbytes(16), rng=world.rng, now=world.now)
        again.link_up(LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a2"], BROADCAST), world.now)
        world.nodes["a2"] = again
        world.run(9.0)
        events = [
            event for event in world.events_of("a", NameConflict) if isinstance(event, NameConflict) and event.own
        ]
        assert len(events) <= 1 + (number + 2) * 9.0 / REPORT_INTERVAL_S
    assert len(events) >= 3


@pytest.mark.parametrize("how", ["says good-bye", "is killed"])
@pytest.mark.parametrize("meanwhile_s", [1.0, 100.0])
def test_when_one_node_leaves_the_other_is_served_again(how: str, meanwhile_s: float) -> None:
    world = conflict()
    world.run(meanwhile_s)
    if how == "says good-bye":
        world.nodes["a2"].close(world.now)
        world._pump("a2")
    del world.nodes["a2"]
    online = len(world.events_of("c", PeerOnline))
    assert world.run(20.0, until=lambda: len(world.events_of("c", PeerOnline)) > online)
    world.run(3.0)
    exchange(world, "a")
    assert world.run(10.0, until=lambda: all(peer.online for peer in world.nodes["a"].conditions(world.now).peers))


def test_the_first_node_is_served_again_after_a_long_silence() -> None:
    world = conflict()
    world.run(5.0)
    first = world.nodes.pop("a")
    world.run(30.0)
    del world.nodes["a2"]
    world.run(15.0)
    world.nodes["a"] = first
    world.run(5.0)
    exchange(world, "a")


def test_messages_from_the_unserved_node_end_as_peer_lost() -> None:
    world = conflict()
    world.send("a", "map", bytes(20_000), "c")
    assert world.run(15.0, until=lambda: bool(world.events_of("a", PeerOffline)))
    assert world.run(60.0, until=lambda: bool(world.events_of("a", MessagePeerLost)))


def test_messages_queued_for_a_shared_name_go_to_the_remaining_node() -> None:
    world = conflict()
    del world.nodes["a2"]
    world.send("c", "map", bytes(20_000), "a")
    assert world.run(20.0, until=lambda: len(world.events_of("c", MessageDelivered)) == 3)
    assert len(world.events_of("a", MessageReceived)) == 2
