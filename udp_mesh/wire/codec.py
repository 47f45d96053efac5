"""Frames to bytes and back: `encode` for a datagram's frames, `decode` for an opened datagram.

A frame starts with its type byte. Types with bit 7 set are fragments, whose low bits are flags; the others are listed
in `Type`. All fields are big-endian. A fragment that ends its datagram has no length field; any other frame has a known
length. Decoding either returns frames within every cap of `limits` or raises `DecodeError`; `decode(encode(frames)) ==
frames`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import assert_never

from udp_mesh.wire import limits
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Heartbeat,
    MessageHead,
    Nack,
    Payload,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    Sent,
    TopicAnnounce,
    Waiting,
)


class Type(IntEnum):
    """The type byte of every frame except the fragment."""

    HEARTBEAT = 1
    ACK = 2
    DELIVERED = 3
    REFUSED = 4
    CANCEL = 5
    NACK = 6
    TOPIC_ANNOUNCE = 7
    PING = 8
    PONG = 9
    BYE = 10
    SENT = 12
    """11 stays free: the tests of the first version use it as an unknown type."""


FRAGMENT = 0x80
FRAGMENT_HAS_HEAD = 0x01
FRAGMENT_HAS_LENGTH = 0x02
FRAGMENT_ACK_NOW = 0x04
FRAGMENT_WIDE = 0x08
"""The position takes 32 bits instead of 16."""
FRAGMENT_BROADCAST_ID = 0x10
FRAGMENT_HAS_LIFE = 0x20
"""The head ends with the message's remaining lifetime."""
_FRAGMENT_KNOWN = 0x80 | 0x3F

_NARROW = struct.Struct(">BIH")
_WIDE = struct.Struct(">BII")
_LENGTH = struct.Struct(">H")
_HEAD = struct.Struct(">IIIHBB")
_ACK = struct.Struct(">B6s3sI")
_HEARTBEAT = struct.Struct(">BBIHHIQI")

FRAGMENT_BYTES = _NARROW.size
"""7 B in front of the payload of a fragment that ends its datagram (9 B from position 65,536 on)."""
FRAGMENT_WIDE_BYTES = _WIDE.size
LENGTH_BYTES = _LENGTH.size
"""2 B more for a fragment followed by other frames."""
HEAD_BYTES = _HEAD.size
"""16 B more in the fragment at position 0."""

LIFE_BYTES = 4
"""4 B more in a head with the message's remaining lifetime."""
SENT_BYTES = 5
"""The frame `Sent`."""

_NO_EXTENSION = b"\x00"
"""Length of an empty heartbeat extension; a reader skips extension fields it does not know."""
_CLOCK = struct.Struct(">I")
"""The first field of the extension: the sender's clock."""

_BITMAP_ONES = (1 << limits.ACK_BITMAP_BITS) - 1


# Encoding


def encode(frames: Sequence[Frame]) -> bytes:
    """The encoded frames of a datagram, in order; a fragment at the end is written without its length.

    Raises ValueError for a value the format cannot carry (a mistake of the caller).
    """
    if len(frames) == 1:
        return _encode_frame(frames[0], last=True)
    if not 1 <= len(frames) <= limits.MAX_FRAMES_PER_DATAGRAM:
        raise ValueError(f"datagram: expected 1 to {limits.MAX_FRAMES_PER_DATAGRAM} frames, found {len(frames)}")
    final = len(frames) - 1
    return b"".join([_encode_frame(frame, last=place == final) for place, frame in enumerate(frames)])


def encode_fragment(fragment: Fragment, *, last: bool = True) -> bytes:
    """One encoded fragment; `last` if no frame follows it in its datagram."""
    message_id, position, payload, head, ack_now, broadcast_id = fragment
    first = FRAGMENT
    if ack_now:
        first |= FRAGMENT_ACK_NOW
    if broadcast_id:
        first |= FRAGMENT_BROADCAST_ID
    if (head is None) != (position != 0):
        raise ValueError("fragment: expected a head exactly at position 0")
    if last and head is None:
        if position < 65_536:
            return _NARROW.pack(first, message_id, position) + payload
        return _WIDE.pack(first | FRAGMENT_WIDE, message_id, position) + payload
    parts: list[Payload] = []
    if not last:
        first |= FRAGMENT_HAS_LENGTH
    if head is not None:
        first |= FRAGMENT_HAS_HEAD if head.life_ms is None else FRAGMENT_HAS_HEAD | FRAGMENT_HAS_LIFE
    if position < 65_536:
        parts.append(_NARROW.pack(first, message_id, position))
    else:
        parts.append(_WIDE.pack(first | FRAGMENT_WIDE, message_id, position))
    if head is not None:
        parts.append(_encode_head(head))
    if not last:
        parts.append(_LENGTH.pack(len(payload)))
    parts.append(payload)
    return b"".join(parts)


def _encode_head(head: MessageHead) -> bytes:
    if head.size_bytes > limits.MAX_MESSAGE_BYTES or not 1 <= head.fragments <= max(1, head.size_bytes):
        raise ValueError(f"message head: {head.size_bytes} bytes in {head.fragments} fragments is out of range")
    if head.fragments > limits.MAX_FRAGMENTS_PER_MESSAGE or not 0 <= head.priority < limits.PRIORITY_LEVELS:
        raise ValueError(f"message head: {head.fragments} fragments, priority {head.priority} is out of range")
    age_ms = min(head.age_ms, 0xFFFFFFFF)
    packed = _HEAD.pack(head.size_bytes, head.fragments, age_ms, head.topic_id, head.priority, head.flags)
    if head.life_ms is None:
        return packed
    if head.life_ms < 1:
        raise ValueError(f"message head: expected a remaining lifetime of at least 1 ms, found {head.life_ms}")
    return packed + min(head.life_ms, 0xFFFFFFFF).to_bytes(LIFE_BYTES, "big")


def _encode_frame(frame: Frame, *, last: bool) -> bytes:
    match frame:
        case Fragment():
            return encode_fragment(frame, last=last)
        case Ack():
            return _encode_ack(frame)
        case Heartbeat():
            return _encode_heartbeat(frame)
        case Delivered(message_ids, broadcast_ids):
            return bytes((Type.DELIVERED,)) + _encode_ids(message_ids, broadcast_ids)
        case Refused(message_id, reason, broadcast_id):
            return struct.pack(">BBIB", Type.REFUSED, broadcast_id, message_id, reason)
        case Cancel(message_ids, broadcast_ids):
            return bytes((Type.CANCEL,)) + _encode_ids(message_ids, broadcast_ids)
        case Nack(message_id, ranges):
            if len(ranges) > limits.MAX_RANGES:
                raise ValueError(f"nack: expected at most {limits.MAX_RANGES} ranges, found {len(ranges)}")
            packed = b"".join(struct.pack(">II", first, count) for first, count in ranges)
            return struct.pack(">BIB", Type.NACK, message_id, len(ranges)) + packed
        case TopicAnnounce(topic_id, name, type_name):
            return (
                struct.pack(">BH", Type.TOPIC_ANNOUNCE, topic_id)
                + encode_text(name, limits.MAX_TOPIC_BYTES, "topic")
                + encode_text(type_name, limits.MAX_TYPE_BYTES, "type name")
            )
        case Ping(token):
            return struct.pack(">BQ", Type.PING, token)
        case Pong(token, held_us):
            return struct.pack(">BQI", Type.PONG, token, held_us)
        case Bye(reason):
            return bytes((Type.BYE,)) + encode_text(reason, limits.MAX_REASON_BYTES, "reason")
        case Sent(clock_ms):
            return struct.pack(">BI", Type.SENT, clock_ms)
        case _:
            assert_never(frame)


def _encode_ack(ack: Ack) -> bytes:
    missing = ~ack.received & _BITMAP_ONES if ack.largest else 0
    # No packet below 0 was ever sent: those bits carry nothing and cost nothing.
    missing &= (1 << min(ack.largest, limits.ACK_BITMAP_BITS)) - 1
    width = (missing.bit_length() + 7) // 8
    return b"".join(
        (
            _ACK.pack(Type.ACK, ack.largest.to_bytes(6, "big"), ack.delay_us.to_bytes(3, "big"), ack.receive_rate),
            bytes((width,)),
            missing.to_bytes(width, "little"),
            _encode_waiting(ack.waiting),
        )
    )


def _encode_heartbeat(beat: Heartbeat) -> bytes:
    if len(beat.heard) > limits.MAX_HEARD or any(len(tag) != limits.HEARD_TAG_BYTES for tag in beat.heard):
        raise ValueError(
            f"heartbeat: expected at most {limits.MAX_HEARD} tags of {limits.HEARD_TAG_BYTES} bytes, "
            f"found {len(beat.heard)}"
        )
    return b"".join(
        (
            bytes((Type.HEARTBEAT,)),
            encode_text(beat.name, limits.MAX_NAME_BYTES, "name"),
            _HEARTBEAT.pack(
                beat.min_version,
                beat.max_version,
                beat.features,
                beat.interval_ms,
                beat.known_peers,
                beat.send_rate,
                beat.broadcast_number,
                beat.broadcast_messages,
            ),
            bytes((len(beat.heard),)),
            *beat.heard,
            _encode_waiting(beat.waiting),
            _NO_EXTENSION if beat.clock_ms is None else b"\x04" + _CLOCK.pack(beat.clock_ms),
        )
    )


def _encode_waiting(waiting: Sequence[Waiting]) -> bytes:
    if len(waiting) > limits.MAX_WAITING:
        raise ValueError(f"expected at most {limits.MAX_WAITING} waiting levels, found {len(waiting)}")
    return bytes((len(waiting),)) + b"".join(
        struct.pack(">BH", level.priority, min(level.age_ms, 0xFFFF)) for level in waiting
    )


def _encode_ids(ids: Iterable[int], broadcast: bool) -> bytes:
    packed = [struct.pack(">I", number) for number in ids]
    if not 1 <= len(packed) <= limits.MAX_IDS:
        raise ValueError(f"expected 1 to {limits.MAX_IDS} message ids, found {len(packed)}")
    return struct.pack(">BH", broadcast, len(packed)) + b"".join(packed)


# Decoding


def decode(data: bytes | memoryview) -> list[Frame]:
    """The frames of an opened datagram; fragments' payloads are views into `data`. Raises `DecodeError`."""
    size = len(data)
    if size >= FRAGMENT_BYTES and data[0] & ~(FRAGMENT_ACK_NOW | FRAGMENT_BROADCAST_ID) == FRAGMENT:
        # The fast path: one narrow fragment that fills the datagram and is not its message's first.
        first, message_id, position = _NARROW.unpack_from(data)
        if position == 0 or size == FRAGMENT_BYTES:
            raise DecodeError("fragment: expected a head at position 0 and a payload elsewhere")
        payload = memoryview(data)[FRAGMENT_BYTES:]
        ack_now, broadcast_id = first & FRAGMENT_ACK_NOW != 0, first & FRAGMENT_BROADCAST_ID != 0
        return [Fragment(message_id, position, payload, None, ack_now, broadcast_id)]
    reader = Reader(data)
    frames: list[Frame] = []
    while reader.remaining():
        if len(frames) == limits.MAX_FRAMES_PER_DATAGRAM:
            raise DecodeError(f"datagram: expected at most {limits.MAX_FRAMES_PER_DATAGRAM} frames, found more")
        first = reader.integer(1, "frame type")
        if first & FRAGMENT:
            frames.append(_decode_fragment(first, reader))
            continue
        decoder = _DECODERS.get(first)
        if decoder is None:
            raise DecodeError(f"frame type: expected {min(Type)}-{max(Type)} or a fragment, found {first}")
        frames.append(decoder(reader))
    if not frames:
        raise DecodeError("datagram: expected a frame, found none")
    return frames


def _decode_fragment(first: int, reader: Reader) -> Fragment:
    if first & ~_FRAGMENT_KNOWN:
        raise DecodeError(f"fragment: expected flags below {_FRAGMENT_KNOWN:#04x}, found {first:#04x}")
    message_id = reader.integer(4, "message id")
    position = reader.integer(4 if first & FRAGMENT_WIDE else 2, "fragment position")
    if position >= limits.MAX_FRAGMENTS_PER_MESSAGE or (first & FRAGMENT_WIDE and position < 65_536):
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


def _decode_heartbeat(reader: Reader) -> Heartbeat:
    name = reader.name(limits.MAX_NAME_BYTES, "node name")
    if "/" in name:
        raise DecodeError(f"node name: expected no slash, found {name!r}")
    low, high, features, interval_ms, known, rate, number, messages = _HEARTBEAT.unpack(
        reader.take(_HEARTBEAT.size, "heartbeat")
    )
    if not 1 <= low <= high <= 7:
        raise DecodeError(f"wire versions: expected a range within 1-7, found {low}-{high}")
    if interval_ms == 0:
        raise DecodeError("heartbeat interval: expected at least 1 ms, found 0")
    count = reader.at_most(1, limits.MAX_HEARD, "number of heard boots")
    tags = bytes(reader.take(count * limits.HEARD_TAG_BYTES, "heard boots"))
    heard = tuple([tags[at : at + limits.HEARD_TAG_BYTES] for at in range(0, len(tags), limits.HEARD_TAG_BYTES)])
    waiting = _decode_waiting(reader)
    extension = reader.take(reader.integer(1, "extension length"), "heartbeat extension")
    clock_ms = _CLOCK.unpack_from(extension)[0] if len(extension) >= _CLOCK.size else None
    return Heartbeat(name, low, high, features, interval_ms, known, rate, number, messages, heard, waiting, clock_ms)


def _decode_waiting(reader: Reader) -> tuple[Waiting, ...]:
    count = reader.at_most(1, limits.MAX_WAITING, "number of waiting levels")
    if not count:
        return ()
    return tuple(
        Waiting(reader.at_most(1, limits.PRIORITY_LEVELS - 1, "waiting priority"), reader.integer(2, "waiting age"))
        for _ in range(count)
    )


def _decode_ack(reader: Reader) -> Ack:
    largest = reader.integer(6, "largest packet")
    delay_us = reader.integer(3, "acknowledgement delay")
    rate = reader.integer(4, "receive rate")
    width = reader.at_most(1, limits.ACK_BITMAP_BITS // 8, "bitmap length")
    missing = int.from_bytes(reader.take(width, "bitmap"), "little")
    covered = (1 << min(largest, limits.ACK_BITMAP_BITS)) - 1
    if missing & ~covered or (width and missing.bit_length() <= 8 * (width - 1)):
        raise DecodeError("bitmap: expected the shortest one that covers packets down to 0")
    return Ack(largest, ~missing & covered, delay_us, rate, _decode_waiting(reader))


def _decode_ids(reader: Reader) -> tuple[tuple[int, ...], bool]:
    broadcast = reader.at_most(1, 1, "broadcast flag")
    count = reader.at_most(2, limits.MAX_IDS, "number of message ids")
    if not count:
        raise DecodeError("message ids: expected at least one, found none")
    return struct.unpack(f">{count}I", reader.take(4 * count, "message ids")), bool(broadcast)


def _decode_delivered(reader: Reader) -> Delivered:
    return Delivered(*_decode_ids(reader))


def _decode_cancel(reader: Reader) -> Cancel:
    return Cancel(*_decode_ids(reader))


def _decode_refused(reader: Reader) -> Refused:
    broadcast = reader.at_most(1, 1, "broadcast flag")
    message_id = reader.integer(4, "message id")
    reason = reader.integer(1, "refuse reason")
    if not min(RefuseReason) <= reason <= max(RefuseReason):
        raise DecodeError(f"refuse reason: expected {min(RefuseReason)}-{max(RefuseReason)}, found {reason}")
    return Refused(message_id, RefuseReason(reason), bool(broadcast))


def _decode_nack(reader: Reader) -> Nack:
    message_id = reader.integer(4, "message id")
    count = reader.at_most(1, limits.MAX_RANGES, "number of ranges")
    ranges = []
    for _ in range(count):
        first, length = reader.integer(4, "first missing"), reader.integer(4, "missing count")
        if length == 0 or first + length > limits.MAX_FRAGMENTS_PER_MESSAGE:
            raise DecodeError(f"missing range: {first} + {length} is out of range")
        ranges.append((first, length))
    return Nack(message_id, tuple(ranges))


def _decode_topic(reader: Reader) -> TopicAnnounce:
    topic_id = reader.integer(2, "topic id")
    name = reader.name(limits.MAX_TOPIC_BYTES, "topic name")
    return TopicAnnounce(topic_id, name, reader.text(limits.MAX_TYPE_BYTES, "type name"))


_DECODERS: dict[int, Callable[[Reader], Frame]] = {
    Type.HEARTBEAT: _decode_heartbeat,
    Type.ACK: _decode_ack,
    Type.DELIVERED: _decode_delivered,
    Type.REFUSED: _decode_refused,
    Type.CANCEL: _decode_cancel,
    Type.NACK: _decode_nack,
    Type.TOPIC_ANNOUNCE: _decode_topic,
    Type.PING: lambda reader: Ping(reader.integer(8, "ping token")),
    Type.PONG: lambda reader: Pong(reader.integer(8, "pong token"), reader.integer(4, "pong hold time")),
    Type.BYE: lambda reader: Bye(reader.text(limits.MAX_REASON_BYTES, "reason")),
    Type.SENT: lambda reader: Sent(reader.integer(4, "clock")),
}
