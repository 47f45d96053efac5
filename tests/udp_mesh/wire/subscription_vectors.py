"""The wire vectors of messages about subscriptions, for `make_vectors`."""

from __future__ import annotations

import struct

from udp_mesh.core.subscriptions.messages import (
    MAX_ENTRIES,
    MAX_GENERATION,
    MAX_PATTERNS,
    MAX_TABLE_BYTES,
    Bounds,
    Subscription,
    SubscriptionTable,
    encode_ask,
    encode_table,
)

SUBSCRIPTIONS: dict[str, SubscriptionTable | None] = {
    "ask": None,
    "nothing": SubscriptionTable(2),
    "everything": SubscriptionTable(1, everything=True),
    "names and patterns": SubscriptionTable(
        MAX_GENERATION,
        (
            Subscription("artifacts/*"),
            Subscription("map", Bounds(rate_hz=0.5, max_age_s=10.0)),
            Subscription("video", Bounds(rate_hz=2.0)),
            Subscription("zustände", Bounds(max_age_s=0.25)),
        ),
    ),
}
"""None: an `Ask`."""


def _table(entries: int, rest: bytes) -> bytes:
    return struct.pack(">BBIH", 1, 0, 1, entries) + rest


def _entry(pattern: bytes) -> bytes:
    return bytes((len(pattern),)) + pattern + bytes(8)


REFUSED_SUBSCRIPTIONS: dict[str, bytes] = {
    "nothing at all": b"",
    "unknown kind": b"\x03",
    "ask with more": encode_ask() + b"\x00",
    "empty pattern": _table(1, _entry(b"")),
    "control character": _table(1, _entry(b"a\nb")),
    "not UTF-8": _table(1, _entry(b"\xff")),
    "cut short": encode_table(SubscriptionTable(1, (Subscription("map"),)))[:-1],
    "fewer entries than bytes": _table(0, _entry(b"map")),
    "too many entries": _table(MAX_ENTRIES + 1, _entry(b"a") * (MAX_ENTRIES + 1)),
    "too many patterns": _table(MAX_PATTERNS + 1, _entry(b"*") * (MAX_PATTERNS + 1)),
    "too many bytes": _table(70, _entry(b"a" * 250) * 70)[: MAX_TABLE_BYTES + 1],
}


def make_subscriptions() -> object:
    """`accepted`: each message with its bytes; `refused`: bytes that are none."""
    return {
        "accepted": {name: _json(message) for name, message in SUBSCRIPTIONS.items()},
        "refused": {name: data.hex() for name, data in REFUSED_SUBSCRIPTIONS.items()},
    }


def _json(message: SubscriptionTable | None) -> dict[str, object]:
    if message is None:
        return {"kind": "ask", "hex": encode_ask().hex()}
    entries = [
        {"pattern": pattern, "rate_hz": bounds.rate_hz, "max_age_s": bounds.max_age_s}
        for pattern, bounds in message.subscriptions
    ]
    return {
        "kind": "table",
        "generation": message.generation,
        "everything": message.everything,
        "subscriptions": entries,
        "hex": encode_table(message).hex(),
    }
