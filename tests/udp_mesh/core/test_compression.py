"""Large messages are compressed and inflated in steps: only later messages of the same topic wait for them."""

import random
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.compression import (
    INFLATE_STEP_BYTES,
    STEP_BYTES,
    Compression,
    Decompression,
    compress,
    decompress,
    start_decompression,
)
from udp_mesh.core.events import ExpiryReason, MessageDelivered, MessageExpired, MessageReceived, Rejected
from udp_mesh.core.peers import features as peer_features
from udp_mesh.core.peers import heartbeat
from udp_mesh.core.receiver import receiver
from udp_mesh.core.settings import Limits, Settings, Topic
from udp_mesh.wire.frames import Feature

TOPICS = (
    Topic("stop", priority=0),
    Topic("map", priority=8, compression=True),
    Topic("tiles", priority=5, compression=True),
)
# of eight values
MAP = random.Random(1).randbytes(40 * STEP_BYTES).translate(bytes(range(8)) * 32)


def world(**changes: object) -> World:
    made = World(seed=2)
    for name in ("a", "b"):
        made.add(settings(name, *TOPICS, **changes))
    made.run(2.0)
    return made


@given(st.binary(max_size=2000), st.integers(1, 200))
def test_incremental_compression_is_compatible_with_zlib(unit: bytes, times: int) -> None:
    payload = unit * times
    body = compress(payload)
    assert body is None or zlib.decompress(body) == payload
    packed = zlib.compress(payload)
    assert decompress(packed, len(payload)) == payload
    assert decompress(packed, max(0, len(payload) - 1)) == (None if payload else b"")


@given(st.binary(min_size=1, max_size=300), st.integers(0, 300))
def test_truncated_input_and_trailing_data_are_rejected(payload: bytes, cut: int) -> None:
    packed = zlib.compress(payload * 50)
    assert decompress(packed[: min(cut, len(packed) - 1)], 1 << 20) is None
    assert decompress(packed + b"x", 1 << 20) is None


@pytest.mark.parametrize("without", ["", "a", "b"])
def test_zstd_is_on_the_wire_between_two_nodes_that_announce_it(without: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """zlib if one of them, `without`, has no zstd."""
    own_features = heartbeat.own_features
    bodies: list[str] = []

    def features(config: Settings) -> int:
        return own_features(config) & ~(Feature.ZSTD if config.name == without else 0)

    def start(body: bytes, flags: int, limit_bytes: int) -> object:
        bodies.append(bytes(body[:4]).hex())
        return start_decompression(body, flags, limit_bytes)

    monkeypatch.setattr(heartbeat, "own_features", features)
    monkeypatch.setattr(peer_features, "own_features", features)
    monkeypatch.setattr(receiver.__name__ + ".start_decompression", start)
    made = world()
    # Compressed at once, and in steps.
    payloads = [b"again and " * 300, b"again and " * 30_000]
    for payload in payloads:
        made.send("a", "map", payload, "b")
        made.run(2.0)
    assert [event.payload for event in made.events_of("b", MessageReceived) if isinstance(event, MessageReceived)] == (
        payloads
    )
    # RFC 8878, 3.1.1, and RFC 1950, 2.2.
    starts = "78" if without else "28b52ffd"
    assert [body[: len(starts)] for body in bodies] == [starts] * 2


def test_compression_step_size_does_not_depend_on_message_size() -> None:
    compression_queue = Compression(MAP)
    steps = 1
    while not compression_queue.step():
        steps += 1
    assert steps == len(MAP) // STEP_BYTES
    assert compression_queue.body is not None
    inflating = Decompression(compression_queue.body, len(MAP))
    steps = 1
    while not inflating.step():
        steps += 1
    assert steps >= len(MAP) // INFLATE_STEP_BYTES
    assert inflating.payload == MAP


def test_a_zip_bomb_inflates_at_most_a_step_beyond_the_limit() -> None:
    inflating = Decompression(zlib.compress(bytes(100 * INFLATE_STEP_BYTES)), INFLATE_STEP_BYTES)
    while not inflating.step():
        pass
    assert inflating.payload is None
    assert inflating.held_bytes < 3 * INFLATE_STEP_BYTES


def test_an_urgent_message_leaves_while_a_map_is_still_being_compressed() -> None:
    made = world()
    made.nodes["a"].send("map", MAP, destination="b", now=made.now)
    assert made.nodes["a"]._state.compression_queue.bytes == len(MAP)
    assert made.nodes["a"].conditions(made.now).queued_bytes == len(MAP)
    made.nodes["a"].handle_timer(made.now)
    made.send("a", "stop", b"now", "b")
    assert made.nodes["a"]._state.compression_queue.bytes == len(MAP)
    assert made.run(60.0, until=lambda: len(made.events_of("b", MessageReceived)) == 2)
    topics = [event.topic for event in made.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert topics == ["stop", "map"]
    assert [event for event in made.events_of("b", MessageReceived) if getattr(event, "payload", b"") == MAP]
    assert made.run(5.0, until=lambda: len(made.events_of("a", MessageDelivered)) == 2)


def test_messages_of_one_topic_keep_their_order_behind_one_that_is_being_compressed() -> None:
    made = world()
    for payload in (MAP, b"second", bytes(3 * STEP_BYTES), b"fourth"):
        made.nodes["a"].send("map", payload, destination="b", now=made.now)
    made.nodes["a"].send("tiles", b"more urgent", destination="b", now=made.now)
    sender = made.nodes["a"]._state.peer_table.peers["b"].open_sender()
    while made.nodes["a"]._state.compression_queue.topics:
        made.nodes["a"].handle_timer(made.now)
    assert [len(message.accepted.payload) for message in sender.pending] == [11, len(MAP), 6, 3 * STEP_BYTES, 6]
    assert made.run(60.0, until=lambda: len(made.events_of("a", MessageDelivered)) == 5)
    assert len(made.events_of("b", MessageReceived)) == 5


def test_the_compression_queue_is_bounded() -> None:
    made = world(limits=Limits(queue_bytes_per_peer=len(MAP) + 100))
    assert not isinstance(made.nodes["a"].send("map", MAP, destination="b", now=made.now), Rejected)
    assert isinstance(made.nodes["a"].send("map", MAP, destination="b", now=made.now), Rejected)


def test_closing_a_node_expires_messages_waiting_for_compression() -> None:
    made = world()
    for _ in range(2):
        made.nodes["a"].send("map", MAP, destination="b", now=made.now)
    made.nodes["a"].handle_timer(made.now)
    made.nodes["a"].close(made.now)
    ended = [event for event in made.events_of("a", MessageExpired) if isinstance(event, MessageExpired)]
    assert [event.reason for event in ended] == [ExpiryReason.CLOSED] * 2
