"""Keys are derived for no sender that a header invents, and once for one whose recorded header is repeated."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import KEY, pair
from udp_mesh.core.peers import unknown_boots
from udp_mesh.core.peers.unknown_boots import MAX_BOOTS
from udp_mesh.crypto import Key, ReceiveChannel, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Heartbeat, Ping
from udp_mesh.wire.header import CHECK_BYTES, LONG_HEADER_BYTES

ATTACKER = ("10.0.0.66", 8700)


@pytest.fixture
def derived(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The boots of unknown senders for which keys were derived."""
    boots: list[bytes] = []

    class Watched(ReceiveChannel):
        def __init__(self, key: Key, sender_boot: bytes, receiver_boot: bytes) -> None:
            boots.append(sender_boot)
            super().__init__(key, sender_boot, receiver_boot)

    monkeypatch.setattr(unknown_boots, "ReceiveChannel", Watched)
    return boots


def test_no_key_is_derived_for_a_header_with_a_wrong_check(derived: list[bytes]) -> None:
    both = pair()
    derived.clear()
    _, sealed = SendChannel(KEY, bytes(range(16)), both.b._state.boot_id).seal_long(encode([Ping(1)]))
    for place in range(LONG_HEADER_BYTES - CHECK_BYTES, LONG_HEADER_BYTES):
        forged = bytearray(sealed)
        forged[place] ^= 1
        before = both.b.conditions(both.now).counters.dropped_unauthenticated
        both.b.receive(bytes(forged), "mesh", ATTACKER, both.now)
        assert both.b.conditions(both.now).counters.dropped_unauthenticated == before + 1
    assert not derived
    both.b.receive(sealed, "mesh", ATTACKER, both.now)
    assert len(derived) == 1


def test_keys_are_derived_once_for_a_recorded_header_with_garbage_behind_it(derived: list[bytes]) -> None:
    both = pair()
    derived.clear()
    channel = SendChannel(KEY, bytes(range(16)))
    recorded = channel.seal_long(encode([Ping(1)]))[1][:LONG_HEADER_BYTES]
    for number in range(100):
        both.b.receive(recorded + number.to_bytes(60, "big"), "mesh", ATTACKER, both.now)
    assert derived == [channel.boot_id]
    assert both.b.conditions(both.now).counters.dropped_unauthenticated == 100
    # the boot itself is not shut out
    beat = channel.seal_long(encode([Heartbeat("late", 1, 1, 0, 1000, 0, 0, 0, 0, ())]))[1]
    both.b.receive(beat, "mesh", ATTACKER, both.now)
    assert channel.boot_id in both.b._state.peer_table.sessions
    assert len(both.b._state.unknown_boots) == 0


def test_the_channels_of_many_recorded_boots_are_not_kept() -> None:
    both = pair()
    for number in range(10 * MAX_BOOTS):
        header = SendChannel(KEY, number.to_bytes(16, "big")).seal_long(b"")[1][:LONG_HEADER_BYTES]
        both.b.receive(header + bytes(60), "mesh", ATTACKER, both.now)
    assert len(both.b._state.unknown_boots) == MAX_BOOTS
