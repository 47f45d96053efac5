"""A path that swallows large datagrams in silence is found out; loss of any other kind is not taken for one."""

import random
from dataclasses import dataclass, replace

import pytest

from tests.udp_mesh.core.pair import BROADCAST, IP_UDP_BYTES, Pipe, World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, PathNarrowed, PeerOnline
from udp_mesh.core.path_size import WIDEN_AFTER_S
from udp_mesh.core.settings import LinkInfo, LinkKind, Topic

TOPICS = (Topic("status", priority=0), Topic("map"))


@dataclass
class Narrow(Pipe):
    """Loses every IP packet above `mtu` and says nothing."""

    mtu: int = 1500

    def carry(self, size_bytes: int, now: float, rng: random.Random) -> float | None:
        if size_bytes + IP_UDP_BYTES > self.mtu:
            self.dropped += 1
            return None
        return Pipe.carry(self, size_bytes, now, rng)


def met(mtu: int, loss: float = 0.0) -> World:
    world = World(seed=1)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    for way in world.pipes:
        world.pipes[way] = Narrow(mtu=mtu, loss=loss)
    assert world.run(20.0, until=lambda: bool(world.told("a", PeerOnline) and world.told("b", PeerOnline)))
    return world


def narrow(world: World) -> list[int]:
    return [event.mtu for event in world.told("a", PathNarrowed) if isinstance(event, PathNarrowed)]


def topics(world: World, name: str, kind: type[MessageDelivered] | type[MessageReceived]) -> list[str]:
    return [event.topic for event in world.told(name, kind) if isinstance(event, MessageDelivered | MessageReceived)]


@pytest.mark.parametrize(
    ("mtu", "found"), [(1499, []), (1400, [1280]), (1280, [1280]), (900, [1280, 576]), (576, [1280, 576])]
)
@pytest.mark.parametrize("telemetry", [True, False])
def test_a_large_message_crosses_a_path_that_is_narrower_than_its_link(
    mtu: int, found: list[int], telemetry: bool
) -> None:
    world = met(mtu)

    def publish() -> None:
        world.send("a", "status", bytes(100), "b")

    world.send("a", "map", bytes(100_000), "b")
    if telemetry:
        for tenth in range(200):
            world.at(world.now + tenth / 10, publish)
    assert world.run(20.0, until=lambda: "map" in topics(world, "a", MessageDelivered))
    assert narrow(world) == found
    world.run(5.0)
    assert topics(world, "b", MessageReceived).count("map") == 1


def test_a_path_that_is_wide_again_carries_full_fragments_after_some_time() -> None:
    world = met(1280)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: bool(world.told("a", MessageDelivered)))
    for way in world.pipes.values():
        assert isinstance(way, Narrow)
        way.mtu = 1500
    world.run(WIDEN_AFTER_S + 10)
    before = world.pipes[("a", "b")].carried
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: len(world.told("a", MessageDelivered)) == 2)
    # 72 full fragments; 84 would be the smaller ones
    assert world.pipes[("a", "b")].carried - before < 80


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_loss_and_cuts_of_any_size_are_not_taken_for_a_narrow_path(loss: float) -> None:
    world = met(1500, loss)
    rng = random.Random(2)

    def cut_or_heal() -> None:
        for way in world.pipes.values():
            way.up = not way.up
        world.at(world.now + rng.uniform(0.05, 1.5), cut_or_heal)

    def publish() -> None:
        world.send("a", "status", bytes(100), "b")
        if rng.random() < 0.1:
            world.send("a", "map", bytes(50_000), "b")
        world.at(world.now + 0.1, publish)

    world.at(world.now, cut_or_heal)
    world.at(world.now, publish)
    world.run(12.0)
    assert narrow(world) == []


def under_way(world: World) -> list[int]:
    """Sizes of the datagrams that leave a from now on, as IP packets."""
    sizes: list[int] = []
    world.tap = lambda name, datagram, _: sizes.append(len(datagram.data) + IP_UDP_BYTES) if name == "a" else None
    world.send("a", "map", bytes(500_000), "b")
    world.run(0.1)
    assert max(sizes) > 1300
    sizes.clear()
    return sizes


def test_what_had_begun_fits_a_link_that_became_narrower() -> None:
    world = met(1500)
    sizes = under_way(world)
    link = LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST, mtu=700)
    world.nodes["a"].link_up(link, world.now)
    assert world.run(20.0, until=lambda: bool(topics(world, "a", MessageDelivered)))
    assert max(sizes) <= 700
    assert topics(world, "b", MessageReceived) == ["map"]


def test_what_had_left_whole_when_the_link_became_narrower_arrives_once() -> None:
    world = met(1500)
    for _ in range(20):
        world.send("a", "map", bytes(3_000), "b")
        # all of it is on its way, and nothing is acknowledged
        world.run(0.012)
        link = LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST, mtu=700)
        world.nodes["a"].link_up(link, world.now)
        world.run(0.5)
        world.nodes["a"].link_up(replace(link, mtu=1500), world.now)
    assert topics(world, "a", MessageDelivered) == ["map"] * 20
    assert topics(world, "b", MessageReceived) == ["map"] * 20


@pytest.mark.parametrize("change", ["link", "settings"])
def test_what_the_path_was_found_to_carry_outlives_a_reload(change: str) -> None:
    world = met(1280)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(30.0, until=lambda: bool(topics(world, "a", MessageDelivered)))
    node = world.nodes["a"]
    if change == "link":
        node.link_up(LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST), world.now)
    else:
        node.apply(settings("a", *TOPICS, window=32), world.now)
    world.pipes["a", "b"].dropped = 0
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(5.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 2)
    assert world.pipes["a", "b"].dropped == 0
    assert narrow(world) == [1280]


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
@pytest.mark.parametrize("loss", [0.05, 0.4])
def test_a_path_that_becomes_long_and_lossy_is_not_taken_for_narrow_nor_does_anything_arrive_twice(
    seed: int, loss: float
) -> None:
    world = World(seed=seed)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    assert world.run(20.0, until=lambda: bool(world.told("a", PeerOnline) and world.told("b", PeerOnline)))
    sent = 0

    def publish() -> None:
        nonlocal sent
        sent += 1
        world.send("a", "status", bytes(100), "b")
        world.send("b", "status", bytes(100), "a")
        if not sent % 10:
            world.send("a", "map", bytes(world.rng.randrange(2_000, 20_000)), "b")
        if sent < 100:
            world.at(world.now + 0.1, publish)

    publish()
    world.run(3.0)
    for way in world.pipes.values():
        way.delay_s, way.loss = 1.0, loss
    assert world.run(60.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 110)
    world.run(5.0)
    assert narrow(world) == []
    assert sorted(topics(world, "b", MessageReceived)) == ["map"] * 10 + ["status"] * 100
