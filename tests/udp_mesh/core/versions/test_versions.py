"""Topics with `delta`: what is sent, what is delivered, and what happens when a base is lost, damaged or unknown."""

from __future__ import annotations

import random

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core import zstd
from udp_mesh.core.events import MessageDelivered, MessageExpired, MessageReceived
from udp_mesh.core.peers import heartbeat
from udp_mesh.core.settings import Limits, Outbox, Topic
from udp_mesh.core.versions.conditions import VersionCounters
from udp_mesh.core.versions.encoding import Version

MAP = Topic("map", delta=True)


def versions_of_a_map(count: int, size: int = 20_000, seed: int = 5) -> list[bytes]:
    """Random cells, of which each version changes some and adds some."""
    rng = random.Random(seed)
    cells = bytearray(rng.randbytes(size))
    made = []
    for _ in range(count):
        for _ in range(10):
            at = rng.randrange(len(cells))
            cells[at : at + 4] = rng.randbytes(8)
        made.append(bytes(cells))
    return made


def world(*topics: Topic, names: str = "ab", seed: int = 3, **changes: object) -> World:
    made = World(seed=seed)
    for name in names:
        made.add(settings(name, *topics, **changes))
    made.run(3.0)
    return made


def received(made: World, name: str, topic: str = "map") -> list[bytes]:
    return [
        event.payload
        for event in made.events_of(name, MessageReceived)
        if isinstance(event, MessageReceived) and event.topic == topic
    ]


def counters(made: World, name: str, topic: str = "map") -> VersionCounters:
    return {entry.topic: entry.counters for entry in made.nodes[name].versions()}.get(topic, VersionCounters())


def send_all(made: World, payloads: list[bytes], to: str | None = "b", every_s: float = 1.0) -> None:
    for payload in payloads:
        made.send("a", "map", payload, to)
        made.run(every_s)


def held(made: World, name: str, by: str) -> object:
    """What `by` holds of the versions of `name`."""
    session = made.nodes[by]._state.peer_table.peers[name].session
    assert session is not None
    return session.receiver.versions.held


def test_each_version_but_the_first_is_sent_as_a_difference() -> None:
    made = world(MAP)
    maps = versions_of_a_map(6)
    send_all(made, maps)
    assert received(made, "b") == maps
    assert len(made.events_of("a", MessageDelivered)) == 6
    sent, got = counters(made, "a"), counters(made, "b")
    assert (sent.whole_sent, sent.differences_sent, sent.not_tried, sent.bases_lost) == (1, 5, 0, 0)
    assert (got.whole_received, got.differences_received) == (1, 5)
    assert sent.payload_bytes_sent == got.payload_bytes_received == sum(map(len, maps))
    assert sent.body_bytes_sent == got.body_bytes_received < 1.2 * len(maps[0])


@pytest.mark.parametrize("size", [0, 1, 100, 3000, 300_000, 2_000_000])
def test_versions_of_any_size_arrive_unchanged(size: int) -> None:
    made = world(MAP)
    maps = versions_of_a_map(3, size) if size else [b"", b"", b""]
    send_all(made, maps, every_s=6.0)
    assert received(made, "b") == maps
    assert len(made.events_of("a", MessageDelivered)) == 3
    assert made.nodes["a"].conditions(made.now).queued_bytes == 0


def test_a_peer_that_joins_late_gets_the_whole_and_then_differences() -> None:
    made = world(MAP)
    maps = versions_of_a_map(6)
    send_all(made, maps[:3], to=None)
    made.add(settings("c", MAP))
    made.run(3.0)
    send_all(made, maps[3:], to=None)
    assert received(made, "b") == maps
    assert received(made, "c") == maps[3:]
    assert counters(made, "c").whole_received == 1


def test_one_encoding_serves_all_peers_with_the_same_base(monkeypatch: pytest.MonkeyPatch) -> None:
    made = world(MAP, names="abcd")
    maps = versions_of_a_map(4)
    send_all(made, maps[:2], to=None)
    compressed: list[int] = []
    begin = zstd.ZstdCompression.__init__

    def count(self: zstd.ZstdCompression, content: bytes, limit: int, prefix: bytes | None = None) -> None:
        compressed.append(len(content))
        begin(self, content, limit, prefix)

    monkeypatch.setattr(zstd.ZstdCompression, "__init__", count)
    send_all(made, maps[2:], to=None)
    assert [received(made, name) for name in "bcd"] == [maps] * 3
    assert len(compressed) == 2


def test_a_receiver_that_restarts_gets_the_whole() -> None:
    made = world(MAP)
    maps = versions_of_a_map(4)
    send_all(made, maps[:2])
    before = received(made, "b")
    made.add(settings("b", MAP))
    made.run(3.0)
    send_all(made, maps[2:])
    assert before + received(made, "b")[len(before) :] == maps
    assert counters(made, "b").whole_received == 1


def test_a_sender_that_restarts_sends_the_whole() -> None:
    made = world(MAP)
    maps = versions_of_a_map(4)
    send_all(made, maps[:2])
    made.add(settings("a", MAP))
    made.run(3.0)
    send_all(made, maps[2:])
    assert received(made, "b") == maps
    assert counters(made, "a").whole_sent == 1
    assert counters(made, "b").bases_missing == 0


@pytest.mark.parametrize("size", [20_000, 600_000])
def test_a_lost_base_is_refused_and_the_whole_follows(size: int) -> None:
    made = world(MAP)
    maps = versions_of_a_map(4, size)
    send_all(made, maps[:2], every_s=3.0)
    made.nodes["b"]._state.peer_table.peers["a"].session.receiver.versions.held.drop_topic(("map", ""))  # type: ignore[union-attr]
    send_all(made, maps[2:], every_s=3.0)
    assert received(made, "b") == maps
    assert len(made.events_of("a", MessageDelivered)) == 4
    assert counters(made, "b").bases_missing == counters(made, "a").bases_lost == 1


@pytest.mark.parametrize("size", [20_000, 600_000])
def test_a_damaged_base_delivers_no_wrong_byte(size: int) -> None:
    made = world(MAP)
    maps = versions_of_a_map(4, size)
    send_all(made, maps[:2], every_s=3.0)
    store = made.nodes["b"]._state.peer_table.peers["a"].session.receiver.versions.held  # type: ignore[union-attr]
    for key, version in list(store._versions.items()):
        damaged = bytearray(version.payload)
        for at in range(0, len(damaged), 50):
            damaged[at] ^= 1
        store._versions[key] = Version(version.digest, bytes(damaged))
    send_all(made, maps[2:], every_s=3.0)
    assert received(made, "b") == maps
    assert len(made.events_of("a", MessageDelivered)) == 4
    assert counters(made, "b").damaged == counters(made, "a").bases_lost == 1


def test_content_that_changes_completely_is_soon_sent_without_trying() -> None:
    made = world(MAP)
    rng = random.Random(8)
    images = [rng.randbytes(5000) for _ in range(40)]
    send_all(made, images, every_s=0.3)
    assert received(made, "b") == images
    sent = counters(made, "a")
    assert sent.whole_sent == 40
    assert sent.not_tried >= 30
    assert sent.body_bytes_sent == 40 * (5000 + 12)


def test_a_version_larger_than_the_limit_is_sent_whole() -> None:
    made = world(Topic("map", delta=True, delta_bytes=10_000))
    maps = versions_of_a_map(3, 20_000)
    send_all(made, maps)
    assert received(made, "b") == maps
    assert counters(made, "a").whole_sent == 3


def test_a_peer_of_an_earlier_version_gets_ordinary_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    made = World(seed=3)
    with monkeypatch.context() as earlier:
        earlier.setattr(heartbeat, "ZSTD_FEATURES", 0)
        made.add(settings("b", Topic("map", delta=True, compression=True)))
    made.add(settings("a", Topic("map", delta=True, compression=True)))
    monkeypatch.setattr(heartbeat, "own_features", _without_zstd_at("b", heartbeat.own_features))
    made.run(3.0)
    maps = [bytes(20_000), bytes(20_001)]
    made.pipes["a", "b"].carried_bytes = 0
    send_all(made, maps)
    assert received(made, "b") == maps
    assert counters(made, "a").whole_sent == 0
    assert made.pipes["a", "b"].carried_bytes < 5000


def _without_zstd_at(name: str, features: object) -> object:
    def own(config: object) -> int:
        found: int = features(config)  # type: ignore[operator]
        return found & ~heartbeat.ZSTD_FEATURES if config.name == name else found  # type: ignore[attr-defined]

    return own


def test_best_effort_versions_are_sent_as_differences() -> None:
    made = world(Topic("map", delta=True, reliable=False))
    maps = versions_of_a_map(5)
    send_all(made, maps)
    assert received(made, "b") == maps
    assert counters(made, "a").differences_sent == 4


def test_a_best_effort_base_that_is_lost_is_replaced() -> None:
    made = world(Topic("map", delta=True, reliable=False))
    maps = versions_of_a_map(6)
    send_all(made, maps[:2])
    made.nodes["b"]._state.peer_table.peers["a"].session.receiver.versions.held.drop_topic(("map", ""))  # type: ignore[union-attr]
    send_all(made, maps[2:])
    assert received(made, "b") == maps[:2] + maps[3:]
    assert counters(made, "a").bases_lost == 1


def test_a_backlog_leaves_in_order_each_as_the_difference_to_one_before() -> None:
    topic = Topic("map", delta=True, outbox=Outbox.ALL)
    made = world(topic)
    maps = versions_of_a_map(8, 100_000)
    send_all(made, maps[:1])
    for pipe in made.pipes.values():
        pipe.up = False
    made.run(20.0)
    send_all(made, maps[1:], every_s=0.1)
    for pipe in made.pipes.values():
        pipe.up = True
    made.run(30.0)
    assert received(made, "b") == maps
    assert counters(made, "a").differences_sent == 7
    assert counters(made, "a").body_bytes_sent < 2 * len(maps[0])


def test_keep_last_replaces_versions_that_wait_to_be_encoded() -> None:
    made = world(Topic("map", delta=True, keep_last=1))
    maps = versions_of_a_map(6, 400_000)
    for payload in maps:
        made.send("a", "map", payload, "b")
    made.run(10.0)
    assert received(made, "b")[-1] == maps[-1]
    ended = len(made.events_of("a", MessageDelivered)) + len(made.events_of("a", MessageExpired))
    assert ended == 6
    assert not made.nodes["a"]._state.versions.jobs
    assert not made.nodes["a"]._state.versions.blocked


def test_versions_held_stay_below_the_limits() -> None:
    limits = Limits(version_bytes_per_peer=50_000, version_bytes=60_000)
    topics = [Topic(f"map{number}", delta=True) for number in range(6)]
    made = world(*topics, limits=limits)
    maps = versions_of_a_map(3)
    for payload in maps:
        for topic in topics:
            made.send("a", topic.name, payload, "b")
            made.run(0.5)
    for topic in topics:
        assert received(made, "b", topic.name) == maps
    assert made.nodes["b"]._state.peer_table.version_memory.bytes <= 50_000
    assert made.nodes["a"]._state.versions.bytes <= 60_000


def test_compressing_more_than_a_topic_may_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    from udp_mesh.core.versions import sent

    monkeypatch.setattr(sent, "MAX_BYTES_PER_S", 50_000)
    made = world(MAP)
    maps = versions_of_a_map(12)
    send_all(made, maps, every_s=0.1)
    assert received(made, "b") == maps
    assert counters(made, "a").not_tried > 5


@pytest.mark.parametrize("seed", range(12))
def test_every_version_arrives_unchanged_through_loss_cuts_and_restarts(seed: int) -> None:
    """Whatever arrives was sent, and every outcome is reported once, on links that lose a fifth and are cut."""
    rng = random.Random(seed)
    topic = Topic("map", delta=True, outbox=Outbox.ALL, compression=bool(seed % 2))
    made = world(topic, names="abc", seed=seed)
    for pipe in made.pipes.values():
        pipe.loss = 0.2
    maps = versions_of_a_map(20, rng.choice([200, 5000, 90_000]), seed)
    for payload in maps:
        # To each by itself: to all, a message that fits a datagram is a broadcast, which may be lost.
        for name in "bc":
            made.send("a", "map", payload, name)
        made.run(rng.choice([0.01, 0.3, 2.0]))
        happening = rng.random()
        if happening < 0.15:
            up = rng.random() < 0.5
            for (source, target), pipe in made.pipes.items():
                if "b" in (source, target):
                    pipe.up = up
        elif happening < 0.25:
            made.add(settings("c", topic))
    for pipe in made.pipes.values():
        pipe.up, pipe.loss = True, 0.0
    made.run(40.0)
    assert sorted(received(made, "b")) == sorted(maps)
    assert set(received(made, "c")) <= set(maps)
    delivered = [event for event in made.events_of("a", MessageDelivered) if getattr(event, "peer", "") == "b"]
    assert len(delivered) == len(maps)
    assert made.nodes["a"].conditions(made.now).queued_bytes == 0
