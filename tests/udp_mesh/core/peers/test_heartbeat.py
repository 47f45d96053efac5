"""Discovery costs a large team a bounded share of its channel, and a node only what it uses."""

import itertools
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import KEY, World, settings
from udp_mesh.core import peer_lifecycle
from udp_mesh.core.events import PeerOffline, PeerOnline
from udp_mesh.core.peers.heartbeat import DISCOVERY_RATE_FACTOR, MIN_GAP_S, REPLY_WITHIN_S, HeartbeatScheduler
from udp_mesh.core.peers.session import Session
from udp_mesh.core.peers.session_state import SessionEvent
from udp_mesh.core.settings import Rates, Topic

RATES = Rates()


def _session(config_name: str = "b") -> Session:
    return Session(config_name, bytes(range(16)), bytes(16), (KEY,), settings(config_name))


@given(st.integers(0, 2000), st.lists(st.floats(0.0, 2.0), min_size=1, max_size=40), st.integers(0, 1 << 30))
def test_heartbeat_replies_never_exceed_the_nodes_rate_share(team: int, waits: list[float], seed: int) -> None:
    heartbeats, now = HeartbeatScheduler(random.Random(seed), RATES, 0.0), 0.0
    share_s = team / (DISCOVERY_RATE_FACTOR * RATES.heartbeats_heard_per_s)
    sent: list[float] = []
    for wait in waits:
        now += wait
        while heartbeats.next_at <= now:
            sent.append(heartbeats.next_at)
            heartbeats.build(settings("a"), [], (), 0, 0.0, heartbeats.next_at)
        heartbeats.reply_to(_session(), team, now)
    gaps = [later - earlier for earlier, later in itertools.pairwise(sent)]
    # One of its own sparse heartbeats may fall between two answers.
    assert all(gap >= min(max(MIN_GAP_S, share_s), 0.9 * RATES.heartbeat_s) - 1e-9 for gap in gaps)


@given(st.integers(0, 1 << 30))
def test_a_new_node_is_answered_immediately_in_a_small_team_and_delayed_in_a_large_one(seed: int) -> None:
    rng = random.Random(seed)
    small, large = (HeartbeatScheduler(rng, RATES, 0.0) for _ in range(2))
    for heartbeats in (small, large):
        heartbeats.build(settings("a"), [], (), 0, 0.0, 0.0)
    small.reply_to(_session(), 10, 0.9)
    large.reply_to(_session(), 1000, 0.1)
    assert small.next_at <= 0.9 + REPLY_WITHIN_S
    assert large.next_at >= 0.9


def test_no_new_node_is_answered_without_its_clock() -> None:
    """Each of a large team would ask each other one for a proof of its first contact."""
    heartbeats, new = HeartbeatScheduler(random.Random(1), RATES, 0.0), []
    for number in range(200):
        session = Session(f"r{number}", number.to_bytes(16, "little"), bytes(16), (KEY,), settings(f"r{number}"))
        session.clock_ms, session.last_heard = 1000 * number, 0.0
        new.append(session)
        heartbeats.reply_to(session, number, 0.0)
    answered: list[bytes] = []
    while len(answered) < len(new):
        now = heartbeats.next_at
        assert now < 20.0
        beat = heartbeats.build(settings("a"), new, (), 0, 0.0, now)
        fresh = [tag for tag in beat.heard if tag not in answered]
        assert fresh == list(beat.heard[: len(fresh)])
        assert 0 < len(fresh) <= len(beat.heard_clocks)
        answered += fresh


def test_a_boot_whose_name_another_one_took_is_not_listed() -> None:
    """So it learns that its messages are not accepted. One that is not verified yet, and one of our own name, have to
    learn that they are heard."""
    heartbeats = HeartbeatScheduler(random.Random(1), RATES, 0.0)

    def session(number: int, name: str, *, verified: bool) -> Session:
        made = Session(name, number.to_bytes(16, "little"), bytes(16), (KEY,), settings(name))
        made.last_heard = 0.0
        if verified:
            made.transition(SessionEvent.VERIFIED)
        return made

    replaced, stranger, namesake = (
        session(1, "b", verified=True),
        session(2, "c", verified=False),
        session(3, "a", verified=True),
    )
    beat = heartbeats.build(settings("a"), [replaced, stranger, namesake], (), 0, 0.0, 0.0)
    assert set(beat.heard) == {stranger.heard_tag, namesake.heard_tag}


def test_a_peer_has_no_sender_until_data_is_sent_to_it() -> None:
    world = World(seed=3)
    for name in ("a", "b", "c"):
        world.add(settings(name, Topic("map")))
    assert world.run(5.0, until=lambda: all(len(world.events_of(name, PeerOnline)) == 2 for name in world.nodes))
    world.run(3.0)
    assert [peer.name for peer in world.nodes["a"]._state.peer_table.peers.values() if peer.sender is not None] == []
    conditions = world.nodes["a"].conditions(world.now)
    assert [(peer.name, peer.online, peer.round_trip_s) for peer in conditions.peers] == [
        ("b", True, None),
        ("c", True, None),
    ]
    world.send("a", "map", bytes(1000), "b")
    assert [peer.name for peer in world.nodes["a"]._state.peer_table.peers.values() if peer.sender is not None] == ["b"]


def test_settings_changed_before_the_first_send_apply_to_later_messages() -> None:
    world = World(seed=3)
    for name in ("a", "b"):
        world.add(settings(name, Topic("map")))
    world.run(3.0)
    world.nodes["a"].apply(settings("a", Topic("map"), window=3), world.now)
    world.send("a", "map", bytes(1000), "b")
    assert world.nodes["a"].conditions(world.now).peers[0].window_packets == 3


def test_every_silent_peer_goes_offline_even_if_a_round_checks_only_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peer_lifecycle, "IDLE_PEERS_PER_ROUND", 1)
    world = World(seed=4)
    for name in "abcdef":
        world.add(settings(name))
    assert world.run(5.0, until=lambda: len(world.events_of("a", PeerOnline)) == 5)
    for name in "bcdef":
        del world.nodes[name]
    assert world.run(20.0, until=lambda: len(world.events_of("a", PeerOffline)) == 5)


def test_heartbeats_report_send_and_arrival_rates() -> None:
    world = World(seed=5)
    for name in ("a", "b", "c"):
        world.add(settings(name, Topic("video", priority=9, reliable=False)))
    world.run(3.0)
    for _ in range(100):
        world.send("a", "video", bytes(10_000), "b")
        world.run(0.1)
    sending = world.nodes["a"].conditions(world.now)
    to_b = next(peer for peer in sending.peers if peer.name == "b")
    # 10 kB ten times a second, with headers.
    assert 0.8e6 < sending.sent_bits_per_s < 1.0e6
    assert to_b.arrived_bits_per_s is not None
    assert 0.8e6 < to_b.arrived_bits_per_s < 1.0e6
    heard = world.nodes["c"].conditions(world.now)
    assert 0.8e6 < heard.heard_bits_per_s < 1.2e6
    world.run(20.0)
    later = world.nodes["a"].conditions(world.now)
    assert next(peer for peer in later.peers if peer.name == "b").arrived_bits_per_s is None
    assert world.nodes["c"].conditions(world.now).heard_bits_per_s < 20_000


def test_new_nodes_beyond_one_heartbeats_capacity_are_listed_soon() -> None:
    heartbeats = HeartbeatScheduler(random.Random(1), RATES, 0.0)
    rng, listed, now = random.Random(2), set[bytes](), 0.0
    strangers = [Session("b", rng.randbytes(16), bytes(16), (KEY,), settings("b")) for _ in range(300)]
    for session in strangers:
        heartbeats.reply_to(session, len(strangers), now)
    while len(listed) < len(strangers):
        now = heartbeats.next_at
        listed.update(heartbeats.build(settings("a"), strangers, (), 0, 0.0, now).heard)
    # Four heartbeats at the pace of discovery, not of a regular interval of ten seconds.
    assert now < 5 * len(strangers) / (DISCOVERY_RATE_FACTOR * RATES.heartbeats_heard_per_s)


def test_heartbeats_become_sparse_only_once_the_peer_has_been_online_for_a_while() -> None:
    world = World(seed=3)
    for name in ("a", "b"):
        world.add(settings(name, Topic("state")))
    assert world.run(5.0, until=lambda: all(world.events_of(name, PeerOnline) for name in world.nodes))
    intervals = []
    for _ in range(50):
        world.send("a", "state", b"here", destination="b")
        world.run(0.2)
        state = world.nodes["a"]._state
        sessions = list(state.peer_table.sessions.values())
        intervals.append(state.heartbeats.interval_s(state.settings, sessions, world.now))
    assert set(intervals[:14]) == {RATES.heartbeat_s}
    assert set(intervals[16:]) == {RATES.heartbeat_sparse_s}
