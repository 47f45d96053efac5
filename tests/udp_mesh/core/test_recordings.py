"""Replays: a recorded datagram that never arrived is rejected later, whatever address it comes from."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest

from tests.udp_mesh.core.pair import KEY, Pair, World, pair, settings
from udp_mesh.core.events import (
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessageReceived,
    PeerAddressChanged,
    PeerOffline,
    PeerOnline,
)
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers import heartbeat, introduction
from udp_mesh.core.peers.path_validation import validate_path
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, Freshness, clock_ms
from udp_mesh.core.settings import LinkInfo, LinkKind, Topic
from udp_mesh.crypto import Key, ReceiveChannel, SendChannel
from udp_mesh.wire.frames import Feature
from udp_mesh.wire.header import DATA_BYTE

A = ("10.0.0.1", 8700)
ATTACKER = ("10.0.0.66", 8700)
STOP = Topic("stop", priority=0, deadline_s=2.0)
BEST = Topic("pose", priority=5, reliable=False)


def acquainted(*topics: Topic) -> Pair:
    """Two nodes that have answered each other, so that short headers suffice."""
    both = pair(*topics)
    for node, other in ((both.a, "b"), (both.b, "a")):
        node.send("any", b"hello", destination=other, now=both.now)
    both.roundtrip(times=30)
    both.events(both.a)
    both.events(both.b)
    return both


def payloads(both: Pair) -> list[bytes]:
    return [event.payload for event in both.events(both.b) if isinstance(event, MessageReceived)]


def overheard(both: Pair, topic: str, payload: bytes) -> list[Datagram]:
    """What is sent to b now, and lost."""
    both.a.send(topic, payload, destination="b", now=both.now)
    return [datagram for datagram in both.drop(both.a) if datagram.data[0] == DATA_BYTE]


def replay(both: Pair, recorded: list[Datagram]) -> None:
    for datagram in recorded:
        both.b.receive(datagram.data, "mesh", ATTACKER, both.now)


def without_dates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both nodes as in the first version: they neither send nor accept timestamps."""
    monkeypatch.setattr(heartbeat, "OWN_FEATURES", Feature.ZLIB | Feature.REPAIR)
    monkeypatch.setattr(heartbeat, "clock_ms", lambda now: None)
    monkeypatch.setattr(introduction, "clock_ms", lambda now: None)


@pytest.mark.parametrize("topic", [STOP, BEST, replace(BEST, reliable=True)])
def test_a_lost_command_is_not_delivered_late(topic: Topic) -> None:
    both = acquainted(topic)
    recorded = overheard(both, topic.name, b"stop")
    # The peers keep hearing each other; the test never retransmits what was lost.
    both.a._state.peer_table.peers["b"].open_sender().finish_all(ExpiryReason.DEADLINE)
    both.roundtrip(times=900, step_s=0.1)
    before = both.b.conditions(both.now).counters
    replay(both, recorded)
    assert payloads(both) == []
    after = both.b.conditions(both.now).counters
    assert (after.dropped_stale, after.dropped_replayed) != (before.dropped_stale, before.dropped_replayed)
    assert both.b.conditions(both.now).peers[0].address == A


def test_a_lost_command_is_rejected_when_replayed_with_no_traffic_since() -> None:
    both = acquainted(BEST)
    recorded = overheard(both, "pose", b"old")
    for _ in range(90):
        both.drop(both.a)
        both.drop(both.b)
        both.now += 1.0
    both.events(both.b)
    replay(both, recorded)
    assert both.events(both.b) == []


@pytest.mark.parametrize("held_s", [0.8, 4.0])
def test_datagrams_delayed_by_a_slow_route_or_short_outage_are_accepted(held_s: float) -> None:
    both = acquainted(BEST)
    held = overheard(both, "pose", b"slow")
    both.roundtrip(times=int(held_s / 0.1), step_s=0.1)
    for datagram in held:
        both.b.receive(datagram.data, "mesh", A, both.now)
    assert payloads(both) == [b"slow"]


def test_an_expired_message_is_not_reassembled() -> None:
    """Its last fragment was lost and recorded; its sender knows that the message expired."""
    both = acquainted(Topic("plan", priority=6, deadline_s=1.0))
    both.a.send("plan", bytes(5000), destination="b", now=both.now)
    *arrived, last = [datagram for datagram in both.drop(both.a) if datagram.data[0] == DATA_BYTE]
    for datagram in arrived:
        both.b.receive(datagram.data, "mesh", A, both.now)
    both.drop(both.b)
    both.now += 3.0
    both.drop(both.a)
    assert any(isinstance(event, MessageExpired) for event in both.events(both.a))
    both.b.receive(last.data, "mesh", A, both.now)
    assert payloads(both) == []


def test_messages_survive_outages_of_several_seconds_and_slowed_routes() -> None:
    world = World(seed=3)
    for name in "ab":
        world.add(settings(name, Topic("map", priority=7)))
    world.run(3.0)
    for cut_s in (3.0, 7.0):
        for pipe in world.pipes.values():
            pipe.up = False
        world.send("a", "map", bytes(50_000), "b")
        world.run(cut_s)
        for pipe in world.pipes.values():
            pipe.up, pipe.delay_s = True, 0.8
        before = len(world.events_of("a", MessageDelivered))
        assert world.run(15.0, until=lambda before=before: len(world.events_of("a", MessageDelivered)) > before)  # type: ignore[misc]
    assert len(world.events_of("b", MessageReceived)) == 2


def silent_world() -> tuple[World, list[Datagram]]:
    """`a` and `b` have met; then `a` sends hellos that b does not hear, and leaves."""
    world = World(seed=2)
    for name in "ab":
        world.add(settings(name))
    world.run(3.0)
    recorded: list[Datagram] = []
    world.pipes["a", "b"].up = False
    world.tap = lambda name, datagram, now: recorded.append(datagram) if name == "a" else None
    world.run(4.0)
    world.tap = None
    del world.nodes["a"]
    assert world.run(30.0, until=lambda: bool(world.events_of("b", PeerOffline)))
    world.run(ACCEPT_AGE_S)
    return world, recorded


@pytest.mark.parametrize("with_timestamp", [True, False])
def test_a_replayed_hello_brings_no_peer_online(with_timestamp: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not with_timestamp:
        without_dates(monkeypatch)
    world, recorded = silent_world()
    online = len(world.events_of("b", PeerOnline))
    assert recorded
    for datagram in recorded:
        world.nodes["b"].receive(datagram.data, "mesh", ATTACKER, world.now)
        world.run(0.3)
    assert len(world.events_of("b", PeerOnline)) == online
    assert not world.events_of("b", PeerAddressChanged)


@pytest.mark.parametrize("with_timestamp", [True, False])
def test_a_returning_peer_is_online_within_a_round_trip_of_its_hello(
    with_timestamp: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not with_timestamp:
        without_dates(monkeypatch)
    world = World(seed=2)
    for name in "ab":
        world.add(settings(name))
    world.run(3.0)
    world.pipes["a", "b"].up = False
    assert world.run(30.0, until=lambda: bool(world.events_of("b", PeerOffline)))
    world.pipes["a", "b"].up = True
    heard: list[float] = []
    world.tap = lambda name, datagram, now: heard.append(now) if name == "a" else None
    online = len(world.events_of("b", PeerOnline))
    assert world.run(5.0, until=lambda: len(world.events_of("b", PeerOnline)) > online)
    assert world.now - heard[0] < 0.010 + 0.020 + 0.005


def test_a_peer_whose_computer_slept_is_accepted_again_within_a_second() -> None:
    """Its clock stood still: its timestamps are an hour old until it answers a challenge."""
    world = World(seed=5)
    for name in "ab":
        world.add(settings(name))
    world.run(3.0)
    session = world.nodes["b"]._state.peer_table.peers["a"].session
    assert session is not None
    assert session.freshness._offset_ms is not None
    session.freshness._offset_ms = (session.freshness._offset_ms - 3_600_000) & 0xFFFFFFFF
    session.freshness.confirm(world.now)
    world.send("a", "any", b"awake", "b")
    assert world.run(1.0, until=lambda: bool(world.events_of("a", MessageDelivered)))


def roaming(seed: int, loss: float) -> World:
    world = World(seed=seed)
    for name in "ab":
        world.add(settings(name, Topic("map", priority=8)))
    world.run(3.0)
    for path in world.pipes.values():
        path.loss = loss
    return world


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.parametrize("with_timestamp", [True, False])
def test_replayed_datagrams_do_not_change_the_peer_address(
    seed: int, with_timestamp: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attacker that replays recorded datagrams from its own address wins the race if the original is lost."""
    if not with_timestamp:
        without_dates(monkeypatch)
    world = roaming(seed, 0.2)

    def repeat(name: str, datagram: Datagram, now: float) -> None:
        if name == "a" and datagram.destination is not None:
            copy = bytes(datagram.data)
            world.at(now + 0.015, lambda: world.nodes["b"].receive(copy, "mesh", ATTACKER, world.now))

    world.tap = repeat

    def both_ways() -> None:
        for name, other in (("a", "b"), ("b", "a")):
            world.nodes[name].send("map", bytes(20_000), destination=other, now=world.now)
        world.at(world.now + 0.1, both_ways)

    both_ways()
    world.run(15.0)
    assert world.events_of("b", PeerAddressChanged) == []
    assert len(world.events_of("b", MessageReceived)) > 100


def test_an_address_change_is_detected_within_a_few_heartbeats() -> None:
    world = roaming(1, 0.0)
    moves: list[float] = []
    world.addresses["b"] = ("10.0.0.99", 8700)
    asked = world.now
    world.send("a", "map", b"where are you", "b")
    assert world.run(6.0, until=lambda: bool(world.events_of("a", PeerAddressChanged)))
    moves.append(world.now - asked)
    # Heard there within 2 s (two heartbeats), plus a round trip of 20 ms.
    assert moves[0] < 3.0
    assert world.run(1.0, until=lambda: bool(world.events_of("a", MessageDelivered)))


def test_messages_from_two_peers_with_colliding_tags_are_received() -> None:
    world = World(seed=4)
    base = world.add(settings("base"))
    rng = random.Random(8)
    own = base._state.boot_id
    tags: dict[int, bytes] = {}
    while True:
        boot = rng.randbytes(16)
        tag = ReceiveChannel(KEY, boot, own).tag
        if tag in tags:
            break
        tags[tag] = boot
    draws = iter((tags[tag], boot))

    class Drawn(random.Random):
        def randbytes(self, n: int) -> bytes:
            return next(draws)

    usual, world.rng = world.rng, Drawn()
    for name in ("one", "two"):
        world.add(settings(name))
    world.rng = usual
    world.run(3.0)
    for number in range(300):
        # The numbers of the one are all seen when those of the other arrive.
        world.send("one", "any", b"%d" % number, "base")
        world.run(0.01)
    world.run(1.0)
    before = len(world.events_of("base", MessageReceived))
    for number in range(40):
        for name in ("one", "two"):
            world.send(name, "any", b"%d" % number, "base")
        world.run(0.05)
    world.run(1.0)
    events = world.events_of("base", MessageReceived)[before:]
    heard = [event.source for event in events if isinstance(event, MessageReceived)]
    assert (heard.count("one"), heard.count("two")) == (40, 40)


def test_packet_numbers_are_never_reused_between_a_pair_of_boots() -> None:
    world = World(seed=6)
    world.add(settings("base"))
    first = world.add(settings("r"))
    world.run(2.0)
    used: set[tuple[int, bytes]] = set()
    doubles: list[int] = []
    seal = SendChannel._take_numbers

    def counted(channel: SendChannel, count: int) -> int:
        number = seal(channel, count)
        for one in range(number, number + count):
            if (one, channel._secret) in used:
                doubles.append(one)
            used.add((one, channel._secret))
        return number

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SendChannel, "_take_numbers", counted)
        for number in range(5):
            world.send("base", "any", b"%d" % number, "r")
            world.run(0.2)
        for _ in range(20):
            del world.nodes["r"]
            world.add(settings("r"))
            world.run(1.0)
            world.send("base", "any", b"x", "r")
            world.run(11.0)
        world.nodes.pop("r").close(world.now)
        world.run(15.0)
        world.nodes["r"] = first
        before = len(world.events_of("r", MessageReceived))
        world.run(5.0)
        world.send("base", "any", b"back", "r")
        assert world.run(10.0, until=lambda: len(world.events_of("r", MessageReceived)) > before)
    assert doubles == []


@pytest.mark.parametrize("away_s", [15.0, 200.0])
@pytest.mark.parametrize("with_timestamp", [True, False])
def test_a_temporarily_replaced_robot_is_accepted_again(
    away_s: float, with_timestamp: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not with_timestamp:
        without_dates(monkeypatch)
    world = World(seed=7)
    world.add(settings("base", Topic("map", priority=7)))
    first = world.add(settings("r", Topic("map", priority=7)))
    world.run(2.0)
    recorded: list[Datagram] = []
    world.tap = lambda name, datagram, now: recorded.append(datagram) if name == "r" else None
    world.send("r", "map", b"once", "base")
    world.run(1.0)
    world.tap = None
    del world.nodes["r"]
    world.add(settings("r", Topic("map", priority=7)))
    world.run(away_s)
    del world.nodes["r"]
    assert world.run(20.0, until=lambda: not world.nodes["base"].conditions(world.now).peers[0].online)
    for datagram in recorded:
        world.nodes["base"].receive(datagram.data, "mesh", ATTACKER, world.now)
        world.run(0.3)
    assert not world.nodes["base"].conditions(world.now).peers[0].online
    assert len(world.events_of("base", MessageReceived)) == 1
    world.nodes["r"] = first
    assert world.run(10.0, until=lambda: world.nodes["base"].conditions(world.now).peers[0].online)
    world.run(2.0)
    world.send("r", "map", b"again", "base")
    world.send("base", "map", b"to you", "r")
    assert world.run(10.0, until=lambda: len(world.events_of("base", MessageReceived)) == 2)
    assert world.run(10.0, until=lambda: bool(world.events_of("base", MessageDelivered)))


def test_replays_stay_rejected_after_rotating_keys_away_and_back() -> None:
    other = Key(bytes(range(1, 33)))
    both = acquainted()
    recorded: list[Datagram] = []
    for number in range(5):
        both.a.send("any", bytes([number]), destination="b", now=both.now)
        both.a.send("any", bytes([number]), now=both.now)
        recorded += both.drop(both.a)
        both.now += 0.01
    for datagram in recorded:
        both.b.receive(datagram.data, "mesh", A, both.now)
    assert len(payloads(both)) == 10
    for keys in ((other,), (KEY,), (other, KEY), (KEY,)):
        for node, name in ((both.a, "a"), (both.b, "b")):
            node.apply(replace(settings(name), keys=keys), both.now)
    before = both.b.conditions(both.now).counters.dropped_replayed
    for datagram in recorded:
        both.b.receive(datagram.data, "mesh", A, both.now)
    assert payloads(both) == []
    assert both.b.conditions(both.now).counters.dropped_replayed == before + len(recorded)
    both.roundtrip(times=30)
    both.a.send("any", b"new", destination="b", now=both.now)
    both.roundtrip(times=30)
    assert payloads(both) == [b"new"]


@pytest.mark.parametrize("knows_the_key_s", [0.0, 60.0])
def test_what_could_not_be_opened_for_want_of_a_key_is_rejected_later(knows_the_key_s: float) -> None:
    """A fragment in the middle of a message has no timestamp: only its number shows its age, under whichever key."""
    other = Key(bytes(range(1, 33)))
    both = acquainted(replace(BEST, reliable=True))

    def use(node: str, *keys: Key) -> None:
        getattr(both, node).apply(replace(settings(node, replace(BEST, reliable=True)), keys=keys), both.now)

    use("a", other, KEY)
    recorded = overheard(both, "pose", bytes(5000))[1:-1]
    both.a._state.peer_table.peers["b"].open_sender().finish_all(ExpiryReason.DEADLINE)
    assert recorded
    replay(both, recorded)
    assert both.b.conditions(both.now).counters.dropped_unauthenticated >= len(recorded)
    use("a", KEY, other)
    both.roundtrip(times=int(600 - knows_the_key_s * 10), step_s=0.1)
    use("b", KEY, other)
    both.roundtrip(times=int(knows_the_key_s * 10), step_s=0.1)
    before = both.b.conditions(both.now).counters.dropped_replayed
    replay(both, recorded)
    now = both.b.conditions(both.now)
    assert (now.partial_bytes, now.counters.dropped_replayed) == (0, before + len(recorded))


def test_clock_wraparound_and_drift_do_not_make_datagrams_stale() -> None:
    freshness = Freshness()
    for minute in range(60 * 24 * 60):
        now = minute * 60.0
        theirs = now * (1 + 5e-4) + 4_294_960.0
        assert freshness.lateness_s(clock_ms(theirs), now) <= 0.1
    assert freshness.lateness_s(clock_ms(theirs), now + 2 * ACCEPT_AGE_S) > ACCEPT_AGE_S


def test_an_authenticated_empty_datagram_is_malformed() -> None:
    both = acquainted()
    session = both.a._state.peer_table.peers["b"].session
    assert session is not None
    both.b.receive(session.path.channel.seal(b"")[1], "mesh", A, both.now)
    both.b.receive(both.a._state.broadcast_channel.seal(b"")[1], "mesh", A, both.now)
    assert both.b.conditions(both.now).counters.dropped_malformed == 2


def test_a_ping_is_answered_where_it_came_from() -> None:
    """Over two links, one of them dead in one direction, each side must be able to verify the other."""
    both = acquainted()
    for node, own in ((both.a, "172.16.0.1"), (both.b, "172.16.0.2")):
        node.link_up(LinkInfo("cable", LinkKind.BROADCAST, (own, 8700), ("172.16.0.255", 8700)), both.now)
    session = both.a._state.peer_table.peers["b"].session
    assert session is not None
    validate_path(both.a._state, session, "cable", ("172.16.0.2", 8700), both.now)
    asked = [datagram for datagram in both.drop(both.a) if datagram.link == "cable" and datagram.data[0] == DATA_BYTE]
    assert len(asked) == 1
    both.b.receive(asked[0].data, "cable", ("172.16.0.1", 8700), both.now)
    answers = [datagram for datagram in both.drop(both.b) if datagram.destination == ("172.16.0.1", 8700)]
    assert [datagram.link for datagram in answers] == ["cable"]
