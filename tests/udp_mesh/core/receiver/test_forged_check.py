"""A long header with a wrong check costs one short hash: no key is derived for the sender that it invents."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import KEY, pair
from udp_mesh.core import receive
from udp_mesh.crypto import Key, ReceiveChannel, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Ping
from udp_mesh.wire.header import CHECK_BYTES, LONG_HEADER_BYTES


def test_no_key_is_derived_for_a_header_with_a_wrong_check(monkeypatch: pytest.MonkeyPatch) -> None:
    both = pair()
    derived: list[bytes] = []

    class Watched(ReceiveChannel):
        def __init__(self, key: Key, sender_boot: bytes, receiver_boot: bytes) -> None:
            derived.append(sender_boot)
            super().__init__(key, sender_boot, receiver_boot)

    monkeypatch.setattr(receive, "ReceiveChannel", Watched)
    _, sealed = SendChannel(KEY, bytes(range(16)), both.b._state.boot_id).seal_long(encode([Ping(1)]))
    for place in range(LONG_HEADER_BYTES - CHECK_BYTES, LONG_HEADER_BYTES):
        forged = bytearray(sealed)
        forged[place] ^= 1
        before = both.b.conditions(both.now).counters.dropped_unauthenticated
        both.b.receive(bytes(forged), "mesh", ("10.0.0.66", 8700), both.now)
        assert both.b.conditions(both.now).counters.dropped_unauthenticated == before + 1
    assert not derived
    both.b.receive(sealed, "mesh", ("10.0.0.66", 8700), both.now)
    assert len(derived) == 1
