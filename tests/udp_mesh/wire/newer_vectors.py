"""Vectors of later versions: heartbeats as they may be sent one day, and what a receiver of today reads in them;
and of messages that have a copy on thin links."""

from __future__ import annotations

from typing import NamedTuple

from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, Frame, Heartbeat, MessageFlag, MessageHead, Ping

ASSIGNED_FEATURES = (1 << 11) - 1
"""Bits 0 to 10; those above have no meaning yet."""
NEW_FIELDS = b"fields of a later version"
_EXTENSION_LENGTH_BYTES, _CLOCK_BYTES, _HEARD_CLOCK_BYTES = 1, 4, 3


class NewerVector(NamedTuple):
    """The frames that a receiver of this version reads, and the bytes of the later one."""

    frames: list[Frame]
    encoded: bytes


def _extended(heartbeat: Heartbeat, fields: bytes, *others: Frame) -> NewerVector:
    """The heartbeat with more fields at the end of its extension, then other frames."""
    plain = encode([heartbeat])
    known = _CLOCK_BYTES + _HEARD_CLOCK_BYTES * len(heartbeat.heard_clocks)
    length_at = len(plain) - known - _EXTENSION_LENGTH_BYTES
    assert plain[length_at] == known
    encoded = plain[:length_at] + bytes((known + len(fields),)) + plain[length_at + 1 :] + fields
    return NewerVector([heartbeat, *others], encoded + (encode(others) if others else b""))


_ALONE = Heartbeat("ugv2", 1, 1, ASSIGNED_FEATURES | 1 << 11, 1000, 0, 0, 9, 0, clock_ms=0xFFFFFFF0)
_MET = Heartbeat("ugv2", 1, 1, 0xFFFFFFFF, 1000, 2, 0, 9, 0, (b"peerone!", b"peertwo!"), (), 1, (0x0A0B0C, 0xFFFFFF))

NEWER: dict[str, NewerVector] = {
    "features without a meaning": NewerVector([_MET], encode([_MET])),
    "new fields of a node that hears no other": _extended(_ALONE, NEW_FIELDS),
    "new fields after the clocks of all heard boots": _extended(_MET, NEW_FIELDS),
    "new fields that fill the extension": _extended(_MET, bytes(255 - _CLOCK_BYTES - 2 * _HEARD_CLOCK_BYTES)),
    "new fields, then another frame": _extended(_MET, NEW_FIELDS, Ping(7)),
}


class NumberedVector(NamedTuple):
    """A message with a copy on thin links: its number there, and the payload."""

    number: int
    payload: bytes

    @property
    def body(self) -> bytes:
        return self.number.to_bytes(2, "big") + self.payload

    @property
    def encoded(self) -> bytes:
        flags = MessageFlag.RELIABLE | MessageFlag.NUMBERED
        return encode([Fragment(14, 0, self.body, MessageHead(len(self.body), 1, 2, 0, flags))])


NUMBERED: dict[str, NumberedVector] = {
    "emergency stop": NumberedVector(0xBEEF, b"\x01"),
    "number zero, empty": NumberedVector(0, b""),
}


def make_numbered() -> object:
    """For `thin.json`: the fragment's bytes, and what its message contains."""
    return {
        name: {"number": vector.number, "payload": vector.payload.hex(), "hex": vector.encoded.hex()}
        for name, vector in NUMBERED.items()
    }
