"""The messages that benchmarks send: a header with kind, number and send time, then padding."""

from __future__ import annotations

import struct
from typing import NamedTuple

# kind, number, CLOCK_MONOTONIC when it was sent; all hosts of a laboratory share one kernel and so one clock
_HEADER = struct.Struct("<BQd")
BULK = 1
URGENT = 2
BULK_BYTES = 50_000
URGENT_BYTES = 200


class Message(NamedTuple):
    kind: int
    number: int
    sent_s: float
    size: int


def encode(kind: int, number: int, now: float, size: int) -> bytes:
    return _HEADER.pack(kind, number, now).ljust(size, b"\x5a")


def decode(data: bytes) -> Message:
    kind, number, sent_s = _HEADER.unpack_from(data)
    return Message(kind, number, sent_s, len(data))
