"""First contacts: a boot that was never heard is believed once it proves that it is there now."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.pair import IP_UDP_BYTES, Pipe, World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived, PeerOnline
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers.first_contact import MAX_HELD_DATAGRAMS
from udp_mesh.core.peers.session import Session
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, clock_echo, clock_ms, echo_age_s
from udp_mesh.core.settings import Topic
from udp_mesh.wire.header import Kind

ATTACKER = ("10.0.0.66", 8700)
STOP = Topic("stop", priority=0)


def world_of(*names: str) -> World:
    world = World(seed=3)
    for name in names:
        world.add(settings(name, STOP))
    return world


def without_echoes(monkeypatch: pytest.MonkeyPatch) -> None:
    """All nodes as in versions that send timestamps but echo no clock."""
    monkeypatch.setattr(Session, "clock_ms", property(lambda _: None, lambda _, value: None))


def one_way() -> tuple[World, list[Datagram]]:
    """`b` never hears `a`, which lists it: a's datagrams are recorded, and a leaves."""
    world = world_of("a", "b")
    recorded: list[Datagram] = []
    world.pipes["a", "b"].up = False
    world.tap = lambda name, datagram, now: recorded.append(datagram) if name == "a" else None
    world.run(5.0)
    world.tap = None
    del world.nodes["a"]
    return world, recorded


@pytest.mark.parametrize("echoes", [True, False])
def test_a_replayed_recording_of_an_unknown_boot_creates_no_peer(echoes: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not echoes:
        without_echoes(monkeypatch)
    world, recorded = one_way()
    assert recorded
    world.run(2 * ACCEPT_AGE_S)
    for datagram in recorded:
        world.nodes["b"].receive(datagram.data, "mesh", ATTACKER, world.now)
        world.run(0.3)
    world.run(30.0)
    assert not world.events_of("b", PeerOnline)


@pytest.mark.parametrize("echoes", [True, False])
def test_nothing_is_delivered_over_a_path_delayed_beyond_the_limit_from_the_start(
    echoes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An attacker that forwards everything late from the first datagram on leaves no earlier one to compare with."""
    if not echoes:
        without_echoes(monkeypatch)
    world = world_of("a", "b")
    world.pipes["a", "b"].delay_s = 1.5 * ACCEPT_AGE_S
    for _ in range(60):
        world.run(2.0)
        world.send("a", "stop", b"halt", "b")
    assert not world.events_of("b", PeerOnline)
    assert not world.events_of("b", MessageReceived)
    world.pipes["a", "b"].delay_s = 0.01
    assert world.run(30.0, until=lambda: bool(world.events_of("b", PeerOnline)))


def test_a_first_contact_needs_no_challenge() -> None:
    """The answer to a hello proves itself: nothing waits a round trip, and no ping is sent."""
    world = world_of("a", "b", "c")
    assert world.run(5.0, until=lambda: all(len(world.events_of(name, PeerOnline)) == 2 for name in "abc"))
    sessions = [session for node in world.nodes.values() for session in node._state.peer_table.sessions.values()]
    assert len(sessions) == 6
    assert all(session.challenged_at == float("-inf") for session in sessions)


def test_a_version_without_clock_echo_is_accepted_after_a_ping(monkeypatch: pytest.MonkeyPatch) -> None:
    without_echoes(monkeypatch)
    world = world_of("a", "b")
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline)))
    world.send("a", "stop", b"halt", "b")
    assert world.run(5.0, until=lambda: bool(world.events_of("a", MessageDelivered)))
    world.run(5.0)
    assert len(world.events_of("b", MessageReceived)) == 1
    assert all(world.events_of(name, PeerOnline) for name in "ab")


def test_held_datagrams_are_bounded_and_every_message_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    without_echoes(monkeypatch)
    world = world_of("a", "b")
    b = world.nodes["b"]
    world.pipes["b", "a"] = Pipe(delay_s=1.0)
    # a believes b, and its own proof is lost
    assert world.run(10.0, until=lambda: any(session.held for session in b._state.peer_table.sessions.values()))
    world.pipes["a", "b"].up = False
    assert world.run(10.0, until=lambda: bool(world.events_of("a", PeerOnline)))
    world.pipes["a", "b"].up = True
    for number in range(5 * MAX_HELD_DATAGRAMS):
        world.send("a", "stop", b"%d" % number + bytes(1000), "b")
    held = 0
    while not world.events_of("b", PeerOnline):
        assert world.now < 1060.0
        held = max(held, *(len(session.held) for session in b._state.peer_table.sessions.values()), 0)
        world.run(0.05)
    assert held == MAX_HELD_DATAGRAMS
    world.run(30.0)
    assert len(world.events_of("b", MessageReceived)) == 5 * MAX_HELD_DATAGRAMS


@pytest.mark.parametrize("echoes", [True, False])
def test_bytes_received_from_a_peer_count_from_its_first_datagram_on_each_once(
    echoes: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Introductions carry payload, and without echoes they are held until a ping is answered."""
    if not echoes:
        without_echoes(monkeypatch)
    world = world_of("a", "b")
    world.pipes["b", "a"].delay_s = 0.3
    b, to_b = world.nodes["b"], world.addresses["b"]
    sent: list[Datagram] = []
    world.tap = lambda name, datagram, now: sent.append(datagram) if datagram.destination == to_b else None
    assert world.run(5.0, until=lambda: bool(world.events_of("a", PeerOnline)))
    world.send("a", "stop", random.Random(1).randbytes(5000), "b")
    world.run(5.0)
    assert len(world.events_of("b", MessageReceived)) == 1
    introductions = [datagram for datagram in sent if datagram.data[0] & 0x0F == Kind.INTRODUCTION]
    assert sum(len(datagram.data) for datagram in introductions) > 5000
    for copy in introductions:
        b.receive(copy.data, "mesh", world.addresses["a"], world.now)
    (peer,) = b.conditions(world.now).peers
    assert peer.received_bytes == sum(len(datagram.data) + IP_UDP_BYTES for datagram in sent)


@pytest.mark.parametrize("now", [5.0, 1e6, 4294967.296 + 3.0, 4294967.296 - 0.001])
def test_echo_age_is_correct_across_the_clock_wraparound(now: float) -> None:
    for age_s in (0.0, 1.0, 4.0, 100.0):
        echo = clock_echo(clock_ms(now - age_s))
        assert age_s <= echo_age_s(echo, now) + 0.256
        assert echo_age_s(echo, now) <= age_s + 0.256
