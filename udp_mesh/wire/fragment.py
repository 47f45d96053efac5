"""The fragment frame: its header's structs, flags and sizes, and its encoder and decoder.

type byte with flags | message id | position | head (at position 0) | length (unless it ends its datagram) | payload

A compact fragment is a whole message; it has no position and a shorter head.
"""

from __future__ import annotations

import struct

from udp_mesh.wire import limits
from udp_mesh.wire.buffer import Reader
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import Fragment, MessageHead, Payload

FRAGMENT = 0x80
FRAGMENT_HAS_HEAD = 0x01
FRAGMENT_HAS_LENGTH = 0x02
FRAGMENT_ACK_NOW = 0x04
FRAGMENT_WIDE = 0x08
"""The position takes 32 bits instead of 16."""
FRAGMENT_BROADCAST_ID = 0x10
FRAGMENT_HAS_LIFE = 0x20
"""The head ends with the message's remaining lifetime."""
FRAGMENT_COMPACT = 0x40
"""A whole message: no position, and a head without its size and number of fragments."""

WIDE_FROM = 65_536
"""Positions from here on need the wide header."""

NARROW_HEADER = struct.Struct(">BIH")
"""Type byte, message id, position."""
WIDE_HEADER = struct.Struct(">BII")
"""The same with `FRAGMENT_WIDE`."""
_LENGTH = struct.Struct(">H")
_HEAD = struct.Struct(">IIIHBB")
FRAGMENT_BYTES = NARROW_HEADER.size
"""7 B in front of the payload of a fragment that ends its datagram (9 B from position 65,536 on)."""
FRAGMENT_WIDE_BYTES = WIDE_HEADER.size
LENGTH_BYTES = _LENGTH.size
"""2 B more for a fragment followed by other frames."""
_COMPACT = struct.Struct(">BIHBBH")
"""Type byte, message id, topic id, priority, message flags, age in ms."""
_COMPACT_REST = struct.Struct(">IHBBH")
COMPACT_BYTES = _COMPACT.size
"""11 B in front of the payload of a compact fragment (13 B if it is followed by other frames)."""
MAX_COMPACT_AGE_MS = 0xFFFF
HEAD_BYTES = _HEAD.size
"""16 B more in the fragment at position 0."""

LIFE_BYTES = 4
"""4 B more in a head with the message's remaining lifetime."""


def encode_fragment(fragment: Fragment, *, last: bool = True, compact: bool = False) -> bytes:
    """One encoded fragment; `last` if no frame follows it in its datagram. With `compact`, the receiver accepts
    `FRAGMENT_COMPACT`."""
    message_id, position, payload, head, ack_now, broadcast_id = fragment
    first = FRAGMENT
    if ack_now:
        first |= FRAGMENT_ACK_NOW
    if broadcast_id:
        first |= FRAGMENT_BROADCAST_ID
    if (head is None) != (position != 0):
        raise ValueError("fragment: expected a head exactly at position 0")
    if compact and head is not None and head.fragments == 1 and head.age_ms <= MAX_COMPACT_AGE_MS:
        return _encode_compact(first, message_id, head, payload, last=last)
    if last and head is None:
        if position < WIDE_FROM:
            return NARROW_HEADER.pack(first, message_id, position) + payload
        return WIDE_HEADER.pack(first | FRAGMENT_WIDE, message_id, position) + payload
    parts: list[Payload] = []
    if not last:
        first |= FRAGMENT_HAS_LENGTH
    if head is not None:
        first |= FRAGMENT_HAS_HEAD if head.life_ms is None else FRAGMENT_HAS_HEAD | FRAGMENT_HAS_LIFE
    if position < WIDE_FROM:
        parts.append(NARROW_HEADER.pack(first, message_id, position))
    else:
        parts.append(WIDE_HEADER.pack(first | FRAGMENT_WIDE, message_id, position))
    if head is not None:
        parts.append(_encode_head(head))
    if not last:
        parts.append(_LENGTH.pack(len(payload)))
    parts.append(payload)
    return b"".join(parts)


def _encode_compact(first: int, message_id: int, head: MessageHead, payload: Payload, *, last: bool) -> bytes:
    if head.size_bytes != len(payload) or not 0 <= head.priority < limits.PRIORITY_LEVELS:
        raise ValueError(f"message head: {head.size_bytes} bytes, priority {head.priority} do not describe the payload")
    first |= FRAGMENT_COMPACT | FRAGMENT_HAS_HEAD
    length = b""
    if not last:
        first |= FRAGMENT_HAS_LENGTH
        length = _LENGTH.pack(len(payload))
    life = b""
    if head.life_ms is not None:
        first |= FRAGMENT_HAS_LIFE
        life = _encode_life(head.life_ms)
    packed = _COMPACT.pack(first, message_id, head.topic_id, head.priority, head.flags, head.age_ms)
    return b"".join((packed, life, length, payload))


def _encode_life(life_ms: int) -> bytes:
    if life_ms < 1:
        raise ValueError(f"message head: expected a remaining lifetime of at least 1 ms, found {life_ms}")
    return min(life_ms, 0xFFFFFFFF).to_bytes(LIFE_BYTES, "big")


def _encode_head(head: MessageHead) -> bytes:
    if head.size_bytes > limits.MAX_MESSAGE_BYTES or not 1 <= head.fragments <= max(1, head.size_bytes):
        raise ValueError(f"message head: {head.size_bytes} bytes in {head.fragments} fragments is out of range")
    if head.fragments > limits.MAX_FRAGMENTS_PER_MESSAGE or not 0 <= head.priority < limits.PRIORITY_LEVELS:
        raise ValueError(f"message head: {head.fragments} fragments, priority {head.priority} is out of range")
    age_ms = min(head.age_ms, 0xFFFFFFFF)
    packed = _HEAD.pack(head.size_bytes, head.fragments, age_ms, head.topic_id, head.priority, head.flags)
    return packed if head.life_ms is None else packed + _encode_life(head.life_ms)


def decode_plain(data: bytes | memoryview) -> Fragment | None:
    """The fast path: one narrow fragment that fills its datagram and is not its message's first; None for others."""
    size = len(data)
    if size >= FRAGMENT_BYTES and data[0] & ~(FRAGMENT_ACK_NOW | FRAGMENT_BROADCAST_ID) == FRAGMENT:
        first, message_id, position = NARROW_HEADER.unpack_from(data)
        if position == 0 or size == FRAGMENT_BYTES:
            raise DecodeError("fragment: expected a head at position 0 and a payload elsewhere")
        payload = memoryview(data)[FRAGMENT_BYTES:]
        ack_now, broadcast_id = first & FRAGMENT_ACK_NOW != 0, first & FRAGMENT_BROADCAST_ID != 0
        return Fragment(message_id, position, payload, None, ack_now, broadcast_id)
    return None


def decode_fragment(first: int, reader: Reader) -> Fragment:
    """Decode a fragment whose type byte `first` was already read."""
    if first & FRAGMENT_COMPACT:
        return _decode_compact(first, reader)
    message_id = reader.integer(4, "message id")
    position = reader.integer(4 if first & FRAGMENT_WIDE else 2, "fragment position")
    if position >= limits.MAX_FRAGMENTS_PER_MESSAGE or (first & FRAGMENT_WIDE and position < WIDE_FROM):
        raise DecodeError(f"fragment position: {position} is out of range")
    if first & FRAGMENT_HAS_LIFE and not first & FRAGMENT_HAS_HEAD:
        raise DecodeError("fragment: expected a remaining lifetime only in a head")
    head = _decode_head(reader, with_life=first & FRAGMENT_HAS_LIFE != 0) if first & FRAGMENT_HAS_HEAD else None
    if (head is None) != (position != 0):
        raise DecodeError(f"fragment: expected a head exactly at position 0, found position {position}")
    count = reader.integer(2, "fragment length") if first & FRAGMENT_HAS_LENGTH else reader.remaining()
    payload = reader.take(count, "fragment payload")
    if head is None:
        if count == 0:
            raise DecodeError("fragment: expected a payload, found none")
    elif (
        (count > head.size_bytes)
        or (count < head.size_bytes) != (head.fragments > 1)
        or (count == 0) != (head.size_bytes == 0)
    ):
        raise DecodeError(
            f"fragment: {count} bytes contradict a message of {head.size_bytes} in {head.fragments} fragments"
        )
    ack_now, broadcast_id = first & FRAGMENT_ACK_NOW != 0, first & FRAGMENT_BROADCAST_ID != 0
    return Fragment(message_id, position, payload, head, ack_now, broadcast_id)


def _decode_compact(first: int, reader: Reader) -> Fragment:
    if not first & FRAGMENT_HAS_HEAD or first & FRAGMENT_WIDE:
        raise DecodeError(f"fragment: expected a compact one to have a head and no position, found flags {first:#04x}")
    message_id, topic_id, priority, flags, age_ms = _COMPACT_REST.unpack(reader.take(_COMPACT_REST.size, "fragment"))
    if priority >= limits.PRIORITY_LEVELS:
        raise DecodeError(f"priority: expected at most {limits.PRIORITY_LEVELS - 1}, found {priority}")
    life_ms = None
    if first & FRAGMENT_HAS_LIFE and (life_ms := reader.integer(LIFE_BYTES, "remaining lifetime")) == 0:
        raise DecodeError("remaining lifetime: expected at least 1 ms, found 0")
    count = reader.integer(2, "fragment length") if first & FRAGMENT_HAS_LENGTH else reader.remaining()
    payload = reader.take(count, "fragment payload")
    head = MessageHead(count, 1, topic_id, priority, flags, age_ms, life_ms)
    return Fragment(message_id, 0, payload, head, first & FRAGMENT_ACK_NOW != 0, first & FRAGMENT_BROADCAST_ID != 0)


def _decode_head(reader: Reader, *, with_life: bool) -> MessageHead:
    size_bytes = reader.at_most(4, limits.MAX_MESSAGE_BYTES, "message size")
    fragments = reader.at_most(4, limits.MAX_FRAGMENTS_PER_MESSAGE, "number of fragments")
    if not 1 <= fragments <= max(1, size_bytes):
        raise DecodeError(f"number of fragments: {fragments} cannot carry {size_bytes} bytes without an empty one")
    age_ms = reader.integer(4, "message age")
    topic_id = reader.integer(2, "topic id")
    priority = reader.at_most(1, limits.PRIORITY_LEVELS - 1, "priority")
    flags = reader.integer(1, "message flags")
    life_ms = reader.integer(LIFE_BYTES, "remaining lifetime") if with_life else None
    if life_ms == 0:
        raise DecodeError("remaining lifetime: expected at least 1 ms, found 0")
    return MessageHead(size_bytes, fragments, topic_id, priority, flags, age_ms, life_ms)
