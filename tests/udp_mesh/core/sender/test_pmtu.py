"""A path that silently drops large datagrams is detected; loss of any other kind is not mistaken for that."""

import random
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import pytest

from tests.udp_mesh.core.pair import BROADCAST, IP_UDP_BYTES, Pipe, World, settings
from udp_mesh.core.events import MessageDelivered, MessageId, MessageReceived, PathNarrowed, PeerOnline
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.pmtu import MAX_PROBE_INTERVAL_S, MAX_PROBES, PathMtu
from udp_mesh.core.sender.sent_packets import Packet, SendSnapshot
from udp_mesh.core.settings import LinkInfo, LinkKind, Topic
from udp_mesh.wire.frames import MessageFlag

TOPICS = (Topic("status", priority=0), Topic("map"), Topic("seen", reliable=False))


@dataclass
class Narrow(Pipe):
    """Silently drops every IP packet above `mtu`."""

    mtu: int = 1500

    def carry(self, size_bytes: int, now: float, rng: random.Random) -> float | None:
        if size_bytes + IP_UDP_BYTES > self.mtu:
            self.dropped += 1
            return None
        return Pipe.carry(self, size_bytes, now, rng)


def met(
    mtu: int,
    loss: float = 0.0,
    *,
    seed: int = 1,
    link_mtu: int = 1500,
    delay_s: float = 0.01,
    fragment_bytes: int = 1400,
) -> World:
    world = World(seed=seed)
    for name in ("a", "b"):
        node = world.add(settings(name, *TOPICS, fragment_bytes=fragment_bytes))
        node.link_up(LinkInfo("mesh", LinkKind.BROADCAST, world.addresses[name], BROADCAST, mtu=link_mtu), world.now)
    for path in world.pipes:
        world.pipes[path] = Narrow(mtu=mtu, loss=loss, delay_s=delay_s)
    assert world.run(20.0, until=partial(knows, world))
    return world


def become(world: World, mtu: int) -> None:
    """Set the MTU of every path."""
    for path in world.pipes.values():
        assert isinstance(path, Narrow)
        path.mtu = mtu


def narrow(world: World) -> list[int]:
    return [event.mtu for event in world.events_of("a", PathNarrowed) if isinstance(event, PathNarrowed)]


def knows(world: World) -> bool:
    return bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline))


def found_narrow(world: World) -> bool:
    return narrow(world) == [1280]


def topics(world: World, name: str, kind: type[MessageDelivered] | type[MessageReceived]) -> list[str]:
    return [
        event.topic for event in world.events_of(name, kind) if isinstance(event, MessageDelivered | MessageReceived)
    ]


@pytest.mark.parametrize(("mtu", "found"), [(1499, []), (1400, [1280]), (1280, [1280]), (900, [576]), (576, [576])])
@pytest.mark.parametrize("telemetry", [True, False])
def test_a_large_message_crosses_a_path_with_an_mtu_below_the_link_mtu(
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
    assert world.nodes["a"].conditions(world.now).peers[0].path_mtu_bytes == [1500, *found][-1]


def largest_of(world: World) -> list[int]:
    """The largest IP packet that a sends from now on."""
    largest = [0]

    def look(name: str, datagram: Datagram, _: float) -> None:
        if name == "a":
            largest[0] = max(largest[0], len(datagram.data) + IP_UDP_BYTES)

    world.tap = look
    return largest


@pytest.mark.parametrize("mtu", [1300, 1400])
@pytest.mark.parametrize("loss", [0.0, 0.2])
@pytest.mark.parametrize("round_trip_s", [0.02, 0.2, 1.0])
def test_a_low_path_mtu_is_detected_quickly_despite_random_loss(mtu: int, loss: float, round_trip_s: float) -> None:
    for seed in (1, 2, 3):
        world = met(mtu, loss, seed=seed, delay_s=round_trip_s / 2)
        world.send("a", "map", bytes(50_000), "b")
        assert world.run(8.0, until=partial(found_narrow, world)), seed


@pytest.mark.parametrize("telemetry", [True, False])
@pytest.mark.parametrize(("round_trip_s", "longest_s"), [(0.02, 0.6), (0.15, 0.8)])
def test_a_black_hole_in_a_path_in_use_is_detected_within_a_second(
    round_trip_s: float, longest_s: float, telemetry: bool
) -> None:
    world = met(1500, delay_s=round_trip_s / 2)

    def publish() -> None:
        world.send("a", "status", bytes(200), "b")
        world.at(world.now + 0.05, publish)

    if telemetry:
        publish()
    for _ in range(100):
        world.send("a", "map", bytes(50_000), "b")
    world.run(2.0)
    become(world, 1300)
    assert world.run(longest_s, until=partial(found_narrow, world))
    assert world.run(15.0, until=lambda: topics(world, "b", MessageReceived).count("map") == 100)


@dataclass
class UrgentOnly(Pipe):
    """Drops everything that is not urgent, as a radio whose bulk queue is full."""

    urgent: bool = True

    def carry(self, size_bytes: int, now: float, rng: random.Random) -> float | None:
        return Pipe.carry(self, size_bytes, now, rng) if self.urgent else None


def test_losses_of_a_priority_are_not_mistaken_for_a_low_mtu() -> None:
    world = met(1500)
    path = world.pipes["a", "b"] = UrgentOnly()

    def look(name: str, datagram: Datagram, _: float) -> None:
        if name == "a":
            path.urgent = datagram.urgent

    world.tap = look

    def publish() -> None:
        world.send("a", "status", bytes(200), "b")
        world.at(world.now + 0.05, publish)

    publish()
    world.send("a", "map", bytes(500_000), "b")
    world.run(4.0)
    assert narrow(world) == []


@pytest.mark.parametrize("size_bytes", [100, 400])
def test_coalesced_small_messages_cross_a_low_mtu_path(size_bytes: int) -> None:
    world = met(1300)
    for _ in range(200):
        world.send("a", "map", bytes(size_bytes), "b")
    assert world.run(15.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 200)


def test_coalesced_messages_do_not_exceed_the_size_of_a_full_fragment() -> None:
    # The loopback, and some tunnels, claim an MTU of 64 KiB.
    world = met(1500, 0.1, link_mtu=65_535)
    largest = largest_of(world)
    for _ in range(300):
        world.send("a", "map", bytes(400), "b")
    world.send("a", "map", bytes(200_000), "b")
    assert world.run(10.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 301)
    assert (narrow(world), largest[0] <= 1500) == ([], True)


@pytest.mark.parametrize(
    ("link_mtu", "fragment_bytes", "mtu", "found"),
    [
        (9000, 8192, 1500, [1500]),
        (65_535, 8192, 1500, [1500]),
        (65_535, 8192, 1300, [1280]),
        # Its fragments fit 1280 bytes anyway.
        (1500, 1000, 900, [576]),
    ],
)
def test_the_path_mtu_is_lowered_only_to_sizes_that_shrink_fragments(
    link_mtu: int, fragment_bytes: int, mtu: int, found: list[int]
) -> None:
    world = met(mtu, link_mtu=link_mtu, fragment_bytes=fragment_bytes)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(15.0, until=lambda: bool(topics(world, "a", MessageDelivered)))
    assert narrow(world) == found


def test_a_broadcast_is_fragmented_for_a_path_with_a_known_low_mtu() -> None:
    world = met(1300)
    world.send("a", "map", bytes(50_000), "b")
    assert world.run(60.0, until=lambda: found_narrow(world))
    world.send("a", "seen", bytes(1380))
    assert world.run(10.0, until=lambda: "seen" in topics(world, "b", MessageReceived))


def test_broadcast_packets_never_exceed_the_ethernet_mtu() -> None:
    world = met(1500, link_mtu=65_535)
    world.send("a", "seen", bytes(20_000))
    assert world.run(1.0, until=lambda: "seen" in topics(world, "b", MessageReceived))


def test_a_recovered_path_carries_full_fragments_after_some_time() -> None:
    world = met(1280)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    become(world, 1500)
    world.run(12.0)
    before = world.pipes[("a", "b")].carried
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 2)
    # 72 full fragments; 84 would be the smaller ones.
    assert world.pipes[("a", "b")].carried - before < 80


def test_a_partially_recovered_path_uses_the_larger_mtu() -> None:
    world = met(900)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    become(world, 1400)
    world.run(60.0)
    world.pipes["a", "b"].dropped = 0
    largest = largest_of(world)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(5.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 2)
    assert (narrow(world), world.pipes["a", "b"].dropped) == ([576], 0)
    assert 1200 < largest[0] <= 1280


def test_a_path_with_a_lasting_low_mtu_is_probed_less_and_less_often() -> None:
    world = met(1400)
    world.send("a", "map", bytes(100_000), "b")
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    start = world.now
    large: list[float] = []

    def look(name: str, datagram: Datagram, now: float) -> None:
        if name == "a" and len(datagram.data) + IP_UDP_BYTES > 1280:
            large.append(now - start)

    world.tap = look

    def publish() -> None:
        world.send("a", "map", bytes(20_000), "b")
        world.at(world.now + 20.0, publish)

    publish()
    world.run(2 * MAX_PROBE_INTERVAL_S + 50.0)
    # 10, 20, 40 .. 320, 600 s after the previous one.
    assert [round(at / 10) * 10 for at in large[::MAX_PROBES]] == [10, 30, 70, 150, 310, 630, 1240]
    assert len(large) == 7 * MAX_PROBES
    assert narrow(world) == [1280]


@pytest.mark.parametrize("loss", [0.0, 0.3, 0.6])
def test_a_wrongly_lowered_path_mtu_is_restored_within_minutes_under_any_loss(loss: float) -> None:
    for seed in range(4):
        world = met(1280, seed=seed)
        world.send("a", "map", bytes(20_000), "b")
        assert world.run(20.0, until=partial(found_narrow, world))
        for path in world.pipes.values():
            assert isinstance(path, Narrow)
            path.mtu, path.loss = 1500, loss
        largest = largest_of(world)
        for _ in range(200):
            world.send("a", "status", bytes(100), "b")
            world.run(0.5)
        largest[0] = 0
        world.send("a", "map", bytes(20_000), "b")
        world.run(1.0)
        assert largest[0] > 1280, seed


def test_probe_intervals_grow_on_a_path_that_carries_only_large_probes() -> None:
    size = PathMtu()
    now = 0.0
    asked: list[float] = []
    while now < 1200.0:
        if size.narrowed_at is None:
            size.on_narrowed(now)
        assert size.probe.confirmed_mtu == 0
        while not size.probe.due(now, 0.0):
            now += 0.5
        asked.append(now)
        size.probe.on_probe_sent(1, 1500)
        size.on_pong(1, now)
        assert size.probe.confirmed_mtu == 1500
        # Wide again, and narrow soon after.
        now += 5.0
        size.narrowed_at = None
    assert asked == [10.0, 35.0, 80.0, 165.0, 330.0, 655.0, 1260.0]


def packet(size_bytes: int, now: float) -> Packet:
    body = bytes(size_bytes)
    accepted = AcceptedMessage(
        MessageId(1), TopicChannel(0, Topic("t"), "t", ""), body, body, MessageFlag.RELIABLE, now, None
    )
    message = OutgoingMessage(accepted, 8, reliable=True)
    message.begin(1, 1400, 1400)
    return Packet(SendSnapshot(now, 0, now, now, app_limited=False), message, 0)


def narrowings(hours: float, arrives: Callable[[float], bool], *, large_arrive: bool = True) -> int:
    """How often the path to an unresponsive peer, probed four times a second, is wrongly narrowed."""
    size = PathMtu()
    large, small = packet(1350, 0.0), packet(100, 0.0)
    count = 0
    for step in range(int(hours * 3600 * 4)):
        now = step / 4
        if size.next_probe_is_small():
            size.on_small_probe_sent()
            if arrives(now):
                size.on_pong(0, now)
        elif not (arrives(now) and large_arrive):
            size.on_lost([large._replace(snapshot=small.snapshot._replace(sent_at=now))])
        elif size.suspect:
            size.on_acked([large], 0, now)
        if size.is_black_hole(now):
            count += 1
            size.on_narrowed(now)
    return count


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95])
def test_hours_of_uniform_loss_are_not_mistaken_for_a_low_mtu(loss: float) -> None:
    rng = random.Random(7)
    assert narrowings(10.0, lambda _: rng.random() >= loss) == 0


@pytest.mark.parametrize("cut_s", [0.3, 1.0, 5.0, 60.0])
@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_hours_of_outages_are_not_mistaken_for_a_low_mtu(cut_s: float, share: float) -> None:
    rng = random.Random(8)
    until, up = 0.0, False

    def arrives(now: float) -> bool:
        nonlocal until, up
        while now >= until:
            up = not up
            until += rng.expovariate(1 / (cut_s * (1 - share) / share if up else cut_s))
        return up

    assert narrowings(5.0, arrives) == 0


def test_sudden_heavy_loss_is_not_mistaken_for_a_low_mtu() -> None:
    rng = random.Random(9)
    # A minute of each, repeatedly.
    assert narrowings(10.0, lambda now: rng.random() >= (0.0 if now % 120 < 60 else 0.84)) == 0


@pytest.mark.parametrize("loss", [0.0, 0.2, 0.36])
def test_a_silent_peer_behind_a_low_mtu_path_is_detected_within_seconds(loss: float) -> None:
    rng = random.Random(10)
    # Every reduction starts a new suspicion: the average distance between them.
    assert 3600 / narrowings(1.0, lambda _: rng.random() >= loss, large_arrive=False) < 10.0


@pytest.mark.parametrize(("round_trip_s", "loss"), [(0.2, 0.7), (1.0, 0.6)])
def test_a_long_path_with_high_loss_is_not_mistaken_for_a_low_mtu(round_trip_s: float, loss: float) -> None:
    for seed in range(2):
        world = World(seed=seed)
        for name in ("a", "b"):
            world.add(settings(name, *TOPICS))
        assert world.run(20.0, until=partial(knows, world))
        for path in world.pipes.values():
            path.rate_bits_per_s, path.delay_s, path.loss = 1e6, round_trip_s / 2, loss
        for tenth in range(300):
            world.send("a", "status", bytes(100), "b")
            world.send("b", "status", bytes(100), "a")
            if not tenth % 10:
                world.send("a", "map", bytes(world.rng.randrange(2_000, 20_000)), "b")
            world.run(0.1)
        assert narrow(world) == [], seed


@pytest.mark.parametrize("loss", [0.0, 0.5])
def test_size_independent_loss_and_outages_are_not_mistaken_for_a_low_mtu(loss: float) -> None:
    world = met(1500, loss)
    rng = random.Random(2)

    def cut_or_heal() -> None:
        for path in world.pipes.values():
            path.up = not path.up
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


def in_flight(world: World) -> list[int]:
    """Sizes, as IP packets, of the datagrams that a sends from now on."""
    sizes: list[int] = []
    world.tap = lambda name, datagram, _: sizes.append(len(datagram.data) + IP_UDP_BYTES) if name == "a" else None
    world.send("a", "map", bytes(500_000), "b")
    world.run(0.1)
    assert max(sizes) > 1300
    sizes.clear()
    return sizes


def test_messages_in_flight_are_refragmented_for_a_lower_link_mtu() -> None:
    world = met(1500)
    sizes = in_flight(world)
    link = LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST, mtu=700)
    world.nodes["a"].link_up(link, world.now)
    assert world.run(20.0, until=lambda: bool(topics(world, "a", MessageDelivered)))
    assert max(sizes) <= 700
    assert topics(world, "b", MessageReceived) == ["map"]


def test_messages_in_flight_during_a_link_mtu_change_arrive_once() -> None:
    world = met(1500)
    for _ in range(20):
        world.send("a", "map", bytes(3_000), "b")
        # All of it is in flight, and nothing is acknowledged.
        world.run(0.012)
        link = LinkInfo("mesh", LinkKind.BROADCAST, world.addresses["a"], BROADCAST, mtu=700)
        world.nodes["a"].link_up(link, world.now)
        world.run(0.5)
        world.nodes["a"].link_up(replace(link, mtu=1500), world.now)
    assert topics(world, "a", MessageDelivered) == ["map"] * 20
    assert topics(world, "b", MessageReceived) == ["map"] * 20


@pytest.mark.parametrize("change", ["link", "settings"])
def test_the_discovered_path_mtu_survives_a_reload(change: str) -> None:
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
def test_a_path_that_becomes_long_and_lossy_keeps_its_mtu_and_causes_no_duplicates(seed: int, loss: float) -> None:
    world = World(seed=seed)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    assert world.run(20.0, until=partial(knows, world))
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
    for path in world.pipes.values():
        path.delay_s, path.loss = 1.0, loss
    assert world.run(60.0, until=lambda: len(topics(world, "a", MessageDelivered)) == 110)
    world.run(5.0)
    assert narrow(world) == []
    assert sorted(topics(world, "b", MessageReceived)) == ["map"] * 10 + ["status"] * 100
