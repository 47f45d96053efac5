"""Hellos with unknown keys are reported, but a flood of them causes few events."""

import random

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.events import KeyMismatch
from udp_mesh.core.peers.key_mismatch import BURST, REFILL_INTERVAL_S
from udp_mesh.crypto import TO_ALL, Key, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Ping


def test_a_flood_of_unknown_keys_is_reported_in_a_few_aggregated_events() -> None:
    both = pair()
    rng = random.Random(1)
    stranger = SendChannel(Key(bytes(range(7, 39))), rng.randbytes(16), TO_ALL)
    flood = 20_000
    for number in range(flood):
        data = stranger.seal_long(encode([Ping(number)]))[1]
        both.b.receive(data, "mesh", (f"10.1.{number >> 8 & 255}.{number & 255}", 8700), both.now)
        both.now += 8.0 / flood
    events = [event for event in both.events(both.b) if isinstance(event, KeyMismatch)]
    assert BURST <= len(events) <= BURST + 2
    both.now += REFILL_INTERVAL_S
    both.roundtrip(times=3, step_s=1.0)
    events += [event for event in both.events(both.b) if isinstance(event, KeyMismatch)]
    assert sum(1 + event.more for event in events) == flood
    assert both.b.conditions(both.now).counters.dropped_unauthenticated >= flood


def test_each_robot_that_missed_a_key_rotation_is_reported_individually() -> None:
    both = pair()
    for host in range(BURST):
        other = SendChannel(Key(bytes(range(9, 41))), bytes([host]) * 16, TO_ALL)
        both.b.receive(other.seal_long(encode([Ping(1)]))[1], "mesh", (f"10.0.0.{100 + host}", 8700), both.now)
    events = [event for event in both.events(both.b) if isinstance(event, KeyMismatch)]
    assert [event.more for event in events] == [0] * BURST
