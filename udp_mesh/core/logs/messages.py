"""The control messages of log nodes: `Have` (what the sender holds and what readers have) and `ItemRequest`.

Both travel as messages of the reserved topic `CONTROL_TOPIC`, items as messages of `item_topic(topic)`: the transport's
priorities, acknowledgments and encryption apply to them. Each list and range is bounded; a decoder returns a value or
raises `DecodeError`.

    Have: 1 | flags 1 (bit 0: complete, bit 1: asks, bits 2-7: order) | entries 2, each:
          topic (text) | source (text) | log id 32 | flags 1 (bit 0: a reader is online here) | holders 1, each:
          name (text; empty: what the sender holds) | ranges 2, each: first 8, length 4
    ItemRequest: 2 | entries 2, each: topic (text) | source (text) | log id 32 | ranges 2, each: first 8, length 4
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from udp_mesh.core.logs.item import FIRST_NUMBER, MAX_NUMBER, LogKey
from udp_mesh.crypto.signing import PUBLIC_KEY_BYTES
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import MAX_LOG_TOPIC_BYTES, MAX_NAME_BYTES

LOG_PREFIX = "~mesh/log"
CONTROL_TOPIC = LOG_PREFIX
"""Reserved topic of `Have` and `ItemRequest`."""

MAX_ENTRIES = 256
"""Logs in one message: bounds the work it can cause. More of them take several messages."""
MAX_HOLDERS = 64
"""Readers per log in one message: the same."""
MAX_RANGES = 256
"""Ranges per holder in one message: the same. Of a more fragmented log the newest ranges are sent."""
MAX_MESSAGE_BYTES = 1 << 20
MAX_RANGE_ITEMS = (1 << 32) - 1

Ranges = tuple[tuple[int, int], ...]
"""(first, last), ascending, disjoint."""

_RANGE = struct.Struct(">QI")
_HAVE, _WANT = 1, 2
_COMPLETE, _ASKS = 1, 2
_ORDER_SHIFT = 2
MAX_ORDER = 63
"""`Have.order` goes from 1 to this, then from 1 again."""
_READER_ONLINE = 1


def item_topic(topic: str) -> str:
    """The reserved topic on which items of a log travel."""
    return f"{LOG_PREFIX}/{topic}"


class Holder(NamedTuple):
    """The items of one log that a reader has, as far as the sender knows."""

    reader: str
    ranges: Ranges


@dataclass(frozen=True, slots=True)
class HaveEntry:
    """One log. `held` replaces what the sender listed before; `readers` only adds to it."""

    log: LogKey
    held: Ranges
    readers: tuple[Holder, ...] = ()
    reader_online: bool = False
    """Whether one of the topic's readers is online at the sender: it will probably get the items itself."""


@dataclass(frozen=True, slots=True)
class Have:
    """`complete`: the sender holds nothing of logs that are not listed here or in the following messages. `asks`: it
    has just met the receiver, whose own messages may have been lost before, and asks for all that it holds. `order`
    counts the messages to this receiver, because they can overtake each other (0: the sender does not count them)."""

    entries: tuple[HaveEntry, ...]
    complete: bool = False
    asks: bool = False
    order: int = 0


@dataclass(frozen=True, slots=True)
class ItemRequest:
    """Requests these items."""

    entries: tuple[tuple[LogKey, Ranges], ...]


def encode_control(message: Have | ItemRequest) -> bytes:
    """The bytes of a message. Raises ValueError beyond a limit (a mistake of the caller)."""
    if len(message.entries) > MAX_ENTRIES:
        raise ValueError(f"entries: expected at most {MAX_ENTRIES}, found {len(message.entries)}")
    out = bytearray()
    match message:
        case Have(entries, complete, asks, order):
            flags = (_COMPLETE if complete else 0) | (_ASKS if asks else 0) | order << _ORDER_SHIFT
            out += struct.pack(">BBH", _HAVE, flags, len(entries))
            for entry in entries:
                holders = (Holder("", entry.held), *entry.readers[: MAX_HOLDERS - 1])
                out += _encode_log(entry.log)
                out += bytes((_READER_ONLINE if entry.reader_online else 0, len(holders)))
                for holder in holders:
                    out += encode_text(holder.reader, MAX_NAME_BYTES, "reader") + _encode_ranges(holder.ranges)
        case ItemRequest(wanted):
            out += struct.pack(">BH", _WANT, len(wanted))
            for log, ranges in wanted:
                out += _encode_log(log) + _encode_ranges(ranges)
    return bytes(out)


def decode_control(data: bytes | memoryview) -> Have | ItemRequest:
    """The message in these bytes. Raises DecodeError."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise DecodeError(f"log message: expected at most {MAX_MESSAGE_BYTES} bytes, found {len(data)}")
    reader = Reader(data)
    kind = reader.integer(1, "kind of log message")
    if kind == _HAVE:
        flags = reader.integer(1, "flags")
        entries = tuple(_read_entry(reader) for _ in range(reader.at_most(2, MAX_ENTRIES, "entries")))
        result: Have | ItemRequest = Have(entries, bool(flags & _COMPLETE), bool(flags & _ASKS), flags >> _ORDER_SHIFT)
    elif kind == _WANT:
        count = reader.at_most(2, MAX_ENTRIES, "entries")
        result = ItemRequest(tuple((_read_log(reader), _read_ranges(reader)) for _ in range(count)))
    else:
        raise DecodeError(f"kind of log message: expected {_HAVE} or {_WANT}, found {kind}")
    if reader.remaining():
        raise DecodeError(f"log message: expected its end, found {reader.remaining()} more bytes")
    return result


def _encode_log(log: LogKey) -> bytes:
    topic = encode_text(log.topic, MAX_LOG_TOPIC_BYTES, "topic")
    return topic + encode_text(log.source, MAX_NAME_BYTES, "source") + log.log_id


def _read_log(reader: Reader) -> LogKey:
    topic = reader.name(MAX_LOG_TOPIC_BYTES, "topic")
    source = reader.name(MAX_NAME_BYTES, "source")
    return LogKey(topic, source, bytes(reader.take(PUBLIC_KEY_BYTES, "log id")))


def _read_entry(reader: Reader) -> HaveEntry:
    log = _read_log(reader)
    flags = reader.integer(1, "flags")
    held: Ranges = ()
    readers: list[Holder] = []
    for _ in range(reader.at_most(1, MAX_HOLDERS, "holders")):
        name = reader.text(MAX_NAME_BYTES, "reader")
        ranges = _read_ranges(reader)
        if name:
            readers.append(Holder(name, ranges))
        else:
            held = ranges
    return HaveEntry(log, held, tuple(readers), bool(flags & _READER_ONLINE))


def _encode_ranges(ranges: Ranges) -> bytes:
    pieces = tuple(_split(ranges))[-MAX_RANGES:]
    return struct.pack(">H", len(pieces)) + b"".join(_RANGE.pack(first, last - first + 1) for first, last in pieces)


def _split(ranges: Ranges) -> Iterable[tuple[int, int]]:
    for first, last in ranges:
        while last - first >= MAX_RANGE_ITEMS:
            yield first, first + MAX_RANGE_ITEMS - 1
            first += MAX_RANGE_ITEMS
        yield first, last


def _read_ranges(reader: Reader) -> Ranges:
    ranges: list[tuple[int, int]] = []
    floor = FIRST_NUMBER
    for _ in range(reader.at_most(2, MAX_RANGES, "ranges")):
        first, length = _RANGE.unpack(reader.take(_RANGE.size, "range"))
        last = first + length - 1
        if first < floor or not length or last > MAX_NUMBER:
            raise DecodeError(f"range: expected ascending numbers of {floor} to {MAX_NUMBER}, found {first}-{last}")
        ranges.append((first, last))
        floor = last + 1
    return tuple(ranges)
