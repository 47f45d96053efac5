"""Sessions: discovery, restarts, migration, name conflicts, keys, versions, replays, links that come and go."""

from __future__ import annotations

import random
from dataclasses import replace

from tests.udp_mesh.core.pair import BROADCAST, KEY, Pair, World, pair, settings
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    Event,
    Incompatible,
    KeyMismatch,
    MessageDelivered,
    MessageReceived,
    PeerAddressChanged,
    PeerOffline,
    PeerOnline,
    PeerRestarted,
)
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import LinkInfo, LinkKind, Neighbour, Rates, Topic
from udp_mesh.crypto import TO_ALL, Key, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Heartbeat
from udp_mesh.wire.limits import HEARD_TAG_BYTES

OTHER_KEY = Key(bytes(range(1, 33)))
A, B = ("10.0.0.1", 8700), ("10.0.0.2", 8700)


def received(both: Pair, node: Endpoint) -> list[bytes]:
    return [event.payload for event in both.events(node) if isinstance(event, MessageReceived)]


def test_two_nodes_see_each_other_online_once() -> None:
    both = Pair(settings("a"), settings("b"))
    for _ in range(30):
        both.roundtrip()
    assert [type(event) for event in both.events(both.a)] == [PeerOnline]
    assert [type(event) for event in both.events(both.b)] == [PeerOnline]


def events_of(versions: tuple[int, int], *, times: int, apart_s: float) -> list[Event]:
    """The events of a node that hears a new node of these wire versions that many times."""
    both = pair()
    boot_id = random.Random(5).randbytes(16)
    channel = SendChannel(KEY, boot_id, TO_ALL)
    heard = (both.b._state.boot_id[:HEARD_TAG_BYTES],)
    for number in range(times):
        beat = Heartbeat("new", *versions, 0, 1000, number, 0, 0, 0, heard)
        both.b.receive(channel.seal_long(encode([beat]))[1], "mesh", ("10.0.0.9", 8700), both.now)
        both.now += apart_s
    return both.events(both.b)


def test_a_node_sharing_a_version_is_admitted_and_an_incompatible_one_reported_once_a_minute() -> None:
    assert PeerOnline in map(type, events_of((1, 2), times=3, apart_s=1.0))
    assert events_of((2, 3), times=50, apart_s=1.0) == [Incompatible("new", ("10.0.0.9", 8700), (2, 3))]
    assert len(events_of((2, 3), times=5, apart_s=61.0)) == 5


def test_a_replayed_heartbeat_brings_no_peer_online() -> None:
    world = World()
    world.add(settings("b"))
    recorded: list[Datagram] = []
    world.tap = lambda name, datagram, now: recorded.append(datagram)
    world.run(3.0)
    rng = random.Random(1)
    late = Endpoint(settings("a"), boot_id=rng.randbytes(16), rng=rng, now=world.now)
    late.link_up(LinkInfo("mesh", LinkKind.BROADCAST, A, BROADCAST), world.now)
    for datagram in recorded:
        late.receive(datagram.data, "mesh", B, world.now)
    assert late.next_event() is None


def test_datagrams_recorded_from_an_earlier_run_are_rejected() -> None:
    both = pair()
    recorded: list[Datagram] = []
    for number in range(5):
        both.a.send("any", bytes([number]), destination="b", now=both.now)
        both.a.send("any", bytes([number]), now=both.now)
        recorded += both.drop(both.a)
    both.b = Endpoint(settings("b"), boot_id=both.rng.randbytes(16), rng=both.rng, now=both.now)
    both.b.link_up(LinkInfo("mesh", LinkKind.BROADCAST, B, BROADCAST), both.now)
    for datagram in recorded:
        both.b.receive(datagram.data, "mesh", A, both.now)
    assert both.events(both.b) == []
    # Nor after the two have met: what was broadcast before stays a replay.
    for _ in range(300):
        both.roundtrip()
    both.events(both.b)
    for datagram in recorded:
        both.b.receive(datagram.data, "mesh", A, both.now)
    assert received(both, both.b) == []


def test_a_replayed_datagram_changes_nothing() -> None:
    both = pair()
    both.a.send("any", b"once", destination="b", now=both.now)
    datagrams = both.drop(both.a)
    for _ in range(3):
        for datagram in datagrams:
            both.b.receive(datagram.data, "mesh", A, both.now)
    assert received(both, both.b) == [b"once"]
    assert both.b.conditions(both.now).counters.dropped_replayed == 2 * len(datagrams)


def test_a_restart_is_detected_at_once_and_reported() -> None:
    world = World()
    world.add(settings("a"))
    world.add(settings("b"))
    world.run(3.0)
    world.add(settings("b"))
    restarted = world.now
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerRestarted)))
    assert world.now - restarted < 0.5
    assert not world.events_of("a", PeerOffline)


def test_a_silent_peer_goes_offline_after_a_timeout_and_a_closed_one_immediately() -> None:
    world = World()
    for name in ("a", "b", "c"):
        world.add(settings(name))
    world.run(3.0)
    for (source, sink), pipe in world.pipes.items():
        pipe.up = "b" not in (source, sink)
    world.run(9.0)
    assert not world.events_of("a", PeerOffline)
    world.run(3.0)
    assert world.events_of("a", PeerOffline) == [PeerOffline("b", left=False)]
    world.nodes["c"].close(world.now)
    world.run(0.1)
    assert world.events_of("a", PeerOffline)[1:] == [PeerOffline("c", left=True)]


def test_messages_follow_a_peer_to_its_new_address() -> None:
    world = World()
    world.add(settings("a"))
    world.add(settings("b"))
    world.run(3.0)
    world.addresses["b"] = ("10.0.0.99", 8700)
    world.nodes["b"].link_up(LinkInfo("mesh", LinkKind.BROADCAST, ("10.0.0.99", 8700), BROADCAST), world.now)
    world.send("a", "any", b"find me", "b")
    assert world.run(6.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    (moved,) = world.events_of("a", PeerAddressChanged)
    assert isinstance(moved, PeerAddressChanged)
    assert moved.new == ("10.0.0.99", 8700)
    assert not world.events_of("a", PeerOffline)


def test_a_node_with_another_key_is_reported_and_not_admitted() -> None:
    both = Pair(settings("a"), replace(settings("b"), keys=(OTHER_KEY,)))
    both.roundtrip(times=300)
    assert both.events(both.a) == [KeyMismatch(B, "mesh")]


def test_keys_rotate_without_losing_a_message() -> None:
    both = pair()
    old_new, new_old, new = (KEY, OTHER_KEY), (OTHER_KEY, KEY), (OTHER_KEY,)
    sent = 0
    for keys in (old_new, new_old, new):
        for node, name in ((both.a, "a"), (both.b, "b")):
            both.a.send("any", bytes(30_000), destination="b", now=both.now)
            sent += 1
            both.roundtrip(times=3)
            assert node.apply(replace(settings(name), keys=keys), both.now) == ["keys: changed"]
            both.roundtrip(times=3)
    both.roundtrip(times=100)
    events = both.events(both.a)
    assert sum(isinstance(event, MessageDelivered) for event in events) == sent
    assert len(received(both, both.b)) == sent
    assert not any(isinstance(event, PeerOffline | PeerRestarted | KeyMismatch) for event in events)


def test_configured_neighbors_connect_without_broadcast() -> None:
    rng = random.Random(2)
    nodes = {}
    for name, own, other in (("a", A, B), ("b", B, A)):
        config = replace(settings(name), neighbours=(Neighbour(other),))
        nodes[name] = Endpoint(config, boot_id=rng.randbytes(16), rng=rng, now=0.0)
        nodes[name].link_up(LinkInfo("tunnel", LinkKind.NEIGHBOURS, own), 0.0)
    now = 0.0
    destinations = set()
    for step in range(300):
        if step == 200:
            nodes["a"].send("any", b"to all", now=now)
        for name, address, to in (("a", A, "b"), ("b", B, "a")):
            nodes[name].handle_timer(now)
            for datagram in nodes[name].datagrams_to_send(now):
                destinations.add(datagram.destination)
                nodes[to].receive(datagram.data, "tunnel", address, now)
        now += 0.01
    assert destinations == {A, B}
    events = []
    while (event := nodes["b"].next_event()) is not None:
        events.append(event)
    assert [type(event) for event in events] == [PeerOnline, MessageReceived]


def test_a_smaller_mtu_restarts_messages_with_smaller_fragments() -> None:
    both = pair()
    both.a.link_up(LinkInfo("mesh", LinkKind.BROADCAST, A, BROADCAST, mtu=576), both.now)
    both.a.send("any", bytes(50_000), destination="b", now=both.now)
    largest = 0
    for _ in range(200):
        for datagram in both.drop(both.a):
            largest = max(largest, len(datagram.data) + 28)
            both.b.receive(datagram.data, "mesh", A, both.now)
        for datagram in both.drop(both.b):
            both.a.receive(datagram.data, "mesh", B, both.now)
        both.now += 0.01
    assert largest <= 576
    assert received(both, both.b) == [bytes(50_000)]


def test_busy_links_make_heartbeats_sparser() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("t", priority=5)))
    world.run(5.0)

    def counted(seconds: float) -> int:
        before = world.nodes["a"].conditions(world.now).counters.heartbeats_sent
        world.run(seconds)
        return world.nodes["a"].conditions(world.now).counters.heartbeats_sent - before

    idle = counted(30.0)

    def chat() -> None:
        world.nodes["a"].send("t", b"x", destination="b", now=world.now)
        world.at(world.now + 0.3, chat)

    chat()
    world.run(3.0)
    busy = counted(30.0)
    assert idle >= 29
    assert busy <= 12


def test_heartbeats_heard_per_second_stay_bounded_as_a_team_grows() -> None:
    rates = Rates(heartbeats_heard_per_s=4.0)
    world = World()
    for number in range(12):
        world.add(settings(f"n{number}", rates=rates))
    world.run(10.0)
    before = {name: node.conditions(world.now).counters.heartbeats_sent for name, node in world.nodes.items()}
    world.run(10.0)
    sent = sum(node.conditions(world.now).counters.heartbeats_sent - before[name] for name, node in world.nodes.items())
    assert sent / 10.0 < 1.3 * 4.0
    assert not world.events_of("n0", PeerOffline)
