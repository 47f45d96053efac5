"""Hostile bytes: random, mutated, replayed, forged by a key holder. Nothing crashes, grows, or delays urgent
messages."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import KEY, Pair, World, pair, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived
from udp_mesh.core.peers.heartbeat import MAX_PENDING_REPLIES
from udp_mesh.core.peers.peer_table import MAX_RETIRED
from udp_mesh.core.peers.session import MAX_PENDING_CONTROL
from udp_mesh.core.settings import Limits, Neighbour, Topic
from udp_mesh.crypto import TO_ALL, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import (
    Ack,
    Cancel,
    Fragment,
    Frame,
    Heartbeat,
    MessageHead,
    Nack,
    Ping,
    Refused,
    RefuseReason,
    TopicAnnounce,
    Waiting,
)
from udp_mesh.wire.limits import HEARD_TAG_BYTES

A = ("10.0.0.1", 8700)
FORGER = ("10.0.0.66", 8700)


def still_works(both: Pair) -> bool:
    both.events(both.a)
    both.events(both.b)
    both.a.send("any", b"still here", destination="b", now=both.now)
    both.roundtrip(times=40)
    return any(isinstance(event, MessageDelivered) for event in both.events(both.a))


@given(st.lists(st.binary(max_size=120), max_size=30))
def test_random_bytes_are_counted_and_dropped(packets: list[bytes]) -> None:
    both = pair()
    for packet in packets:
        both.b.receive(packet, "mesh", FORGER, both.now)
    counters = both.b.conditions(both.now).counters
    assert both.b.next_event() is None
    assert counters.dropped_malformed + counters.dropped_unauthenticated >= len(packets)


def test_mutated_datagrams_of_a_real_session_change_nothing() -> None:
    dice = random.Random(4)
    both = pair()
    both.b.apply(replace(settings("b"), neighbours=(Neighbour(FORGER, name="old", legacy=True),)), both.now)
    for number in range(300):
        both.a.send("any", bytes([number % 256]) * 40, destination="b", now=both.now)
        for datagram in both.drop(both.a):
            forged = bytearray(datagram.data)
            for _ in range(dice.randint(1, 4)):
                forged[dice.randrange(len(forged))] ^= 1 << dice.randrange(8)
            both.b.receive(bytes(forged), "mesh", dice.choice((A, FORGER)), both.now)
            both.b.receive(datagram.data[: dice.randrange(len(datagram.data))], "mesh", A, both.now)
        both.now += 0.01
    assert not any(isinstance(event, MessageReceived) for event in both.events(both.b))
    assert still_works(both)


def test_a_flood_of_invented_senders_cannot_grow_state_without_bound() -> None:
    both = pair(limits=Limits(strangers=8, peers=16))
    rng = random.Random(1)
    for number in range(100):
        channel = SendChannel(KEY, rng.randbytes(16), TO_ALL)
        beat = Heartbeat(f"ghost{number}", 1, 1, 0, 1000, 0, 0, 0, 0)
        _, data = channel.seal_long(encode([beat]))
        both.b.receive(data, "mesh", FORGER, both.now)
    assert len(both.b._state.peer_table.sessions) <= 1 + 8
    assert [peer.name for peer in both.b.conditions(both.now).peers] == ["a"]
    assert still_works(both)


@pytest.mark.parametrize("name", ["b", "ghost", "ghost{}"])
@pytest.mark.parametrize("versions", [(1, 1), (2, 3)])
def test_a_key_holder_inventing_boot_ids_cannot_grow_state_without_bound(name: str, versions: tuple[int, int]) -> None:
    """They hear our boot, so each is verified at once: under one name, under the victim's own, under many."""
    both = pair(limits=Limits(strangers=8, peers=16))
    state = both.b._state
    rng = random.Random(1)
    for number in range(5000):
        boot_id = rng.randbytes(16)
        beat = Heartbeat(name.format(number), *versions, 0, 1000, 0, 0, 0, 0, (state.boot_id[:HEARD_TAG_BYTES],))
        _, data = SendChannel(KEY, boot_id, TO_ALL).seal_long(encode([beat]))
        both.b.receive(data, "mesh", FORGER, both.now)
    assert len(state.peer_table.sessions) <= 1 + 8 + 16 + MAX_RETIRED
    assert len(state.repairs) <= 1 + 8 + 16 + MAX_RETIRED
    assert len(state.incompatible_reported) <= 8
    assert len(state.heartbeats._pending_replies) <= MAX_PENDING_REPLIES
    both.events(both.b)
    both.now += 60.0
    assert still_works(both)


def insider(both: Pair, frames: list[Frame]) -> None:
    """A datagram from a's session with arbitrary frames: a malicious key holder."""
    peer = both.a._state.peer_table.peers["b"]
    assert peer.session is not None
    number, data = peer.session.path.seal(encode(frames))
    peer.open_sender().in_flight.add(number, None)
    both.b.receive(data, "mesh", A, both.now)


def test_partial_messages_from_an_insider_are_capped() -> None:
    limits = Limits(partial_bytes_per_peer=50_000, partials_per_peer=40)
    both = pair(limits=limits)
    for number in range(3000):
        insider(both, [Fragment(1000 + number, 1 + number % 7, bytes(100))])
    conditions = both.b.conditions(both.now)
    assert conditions.partial_bytes <= 50_000
    assert conditions.counters.dropped_over_limit > 0


def test_topics_announced_by_an_insider_are_capped() -> None:
    both = pair(limits=Limits(topics_per_peer=10))
    for number in range(200):
        insider(both, [TopicAnnounce(number, f"t{number}")])
    session = both.b._state.peer_table.peers["a"].session
    assert session is not None
    assert len(session.receiver.topics) <= 10


frames = st.lists(
    st.one_of(
        st.builds(
            Ack,
            st.integers(0, 1 << 47),
            st.integers(0, (1 << 20) - 1),
            st.integers(0, 1 << 20),
            st.just(0),
            st.just(()),
        ),
        st.builds(Ping, st.integers(0, 1 << 60)),
        st.builds(Nack, st.integers(0, (1 << 32) - 1)),
        st.builds(lambda i, b: Cancel((i,), b), st.integers(0, (1 << 32) - 1), st.booleans()),
        st.builds(Refused, st.integers(0, 40), st.sampled_from(RefuseReason), st.booleans()),
        st.builds(
            lambda i, p: Fragment(i, p, b"x", MessageHead(9, 5, 3, 1, 1) if p == 0 else None),
            st.integers(0, 9),
            st.integers(0, 7),
        ),
    ),
    min_size=1,
    max_size=6,
)


@given(st.lists(frames, max_size=25))
def test_arbitrary_insider_frames_cause_no_crash_and_bounded_control_backlog(datagrams: list[list[Frame]]) -> None:
    both = pair()
    both.b.send("any", bytes(5000), destination="a", now=both.now)
    both.drop(both.b)
    for datagram in datagrams:
        adapted = [
            ack._replace(received=ack.received & ((1 << min(ack.largest, 256)) - 1)) if isinstance(ack, Ack) else ack
            for ack in datagram
        ]
        insider(both, adapted)
    session = both.b._state.peer_table.peers["a"].session
    assert session is not None
    assert len(session.pending_control) <= MAX_PENDING_CONTROL
    both.roundtrip(times=10)


def test_a_message_larger_than_the_limit_is_refused_and_its_sender_notified() -> None:
    world = World()
    world.add(settings("a"))
    world.add(settings("b", limits=Limits(message_bytes=10_000)))
    world.run(1.5)
    world.send("a", "any", bytes(20_000), "b")
    world.run(3.0)
    events = [str(getattr(event, "reason", "")) for _, event in world.events["a"]]
    assert "ExpiryReason.REFUSED" in events
    world.send("a", "any", bytes(9_000), "b")
    assert world.run(3.0, until=lambda: bool(world.events_of("a", MessageDelivered)))


@pytest.mark.parametrize("flood_per_s", [2000])
def test_a_flood_of_garbage_does_not_delay_urgent_messages(flood_per_s: int) -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("stop", priority=0)))
    world.run(1.5)
    rng = random.Random(9)

    def flood() -> None:
        world.nodes["b"].receive(rng.randbytes(100), "mesh", FORGER, world.now)
        world.at(world.now + 1 / flood_per_s, flood)

    flood()
    latencies = []
    for _ in range(20):
        sent = world.now
        world.send("a", "stop", b"!", "b")
        before = len(world.events_of("b", MessageReceived))
        assert world.run(1.0, until=lambda before=before: len(world.events_of("b", MessageReceived)) > before)  # type: ignore[misc]
        latencies.append(world.now - sent)
    assert max(latencies) < 0.012


def test_endless_false_waiting_reports_do_not_block_a_node() -> None:
    world = World()
    for name in ("a", "b"):
        world.add(settings(name, Topic("bulk", priority=9)))
    world.run(1.5)

    def claim() -> None:
        world.nodes["a"]._state.priority_backoff.on_waiting((Waiting(0, 60_000),), world.now)
        world.at(world.now + 0.01, claim)

    claim()
    world.send("a", "bulk", bytes(500_000), "b")
    assert world.run(20.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
