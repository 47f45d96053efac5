"""Frames to bytes and back: `encode` for a datagram's frames, `decode` for an opened datagram.

A frame starts with its type byte. Types with bit 7 set are fragments (see `fragment`); the others are listed in `Type`.
All fields are big-endian. A fragment that ends its datagram has no length field; any other frame has a known length.
Decoding either returns frames within every cap of `limits` or raises `DecodeError`; `decode(encode(frames)) == frames`.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from enum import IntEnum
from typing import assert_never

from udp_mesh.wire import limits
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.fragment import FRAGMENT, decode_fragment, decode_plain, encode_fragment
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Heartbeat,
    Nack,
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


_ACK = struct.Struct(">B6s3sI")
_HEARTBEAT = struct.Struct(">BBIHHIQI")

SENT_BYTES = 5
"""The frame `Sent`."""
ANNOUNCE_BYTES = 5
"""The frame `TopicAnnounce` without its two names."""

_NO_EXTENSION = b"\x00"
"""Length of an empty heartbeat extension; a reader skips extension fields it does not know."""
_CLOCK = struct.Struct(">I")
"""The first field of the extension: the sender's clock."""
HEARD_CLOCK_BYTES = 3
"""Each following field: the clock of a heard boot."""

_BITMAP_ONES = (1 << limits.ACK_BITMAP_BITS) - 1


# Encoding


def encode(frames: Sequence[Frame], *, compact: bool = False) -> bytes:
    """The encoded frames of a datagram, in order; a fragment at the end is written without its length. `compact`: the
    receiver accepts compact fragments.

    Raises ValueError for a value the format cannot carry (a mistake of the caller).
    """
    if len(frames) == 1:
        return _encode_frame(frames[0], last=True, compact=compact)
    if not 1 <= len(frames) <= limits.MAX_FRAMES_PER_DATAGRAM:
        raise ValueError(f"datagram: expected 1 to {limits.MAX_FRAMES_PER_DATAGRAM} frames, found {len(frames)}")
    final = len(frames) - 1
    # Without another call for the many fragments of small messages.
    return b"".join(
        [
            encode_fragment(frame, last=place == final, compact=compact)
            if type(frame) is Fragment
            else _encode_frame(frame, last=place == final, compact=compact)
            for place, frame in enumerate(frames)
        ]
    )


def _encode_frame(frame: Frame, *, last: bool, compact: bool) -> bytes:
    match frame:
        case Fragment():
            return encode_fragment(frame, last=last, compact=compact)
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
    if len(beat.heard_clocks) > min(len(beat.heard), limits.MAX_HEARD_CLOCKS):
        raise ValueError(
            f"heartbeat: expected at most {limits.MAX_HEARD_CLOCKS} clocks, one per heard boot, "
            f"found {len(beat.heard_clocks)}"
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
            _encode_clocks(beat.clock_ms, beat.heard_clocks),
        )
    )


def _encode_clocks(clock_ms: int | None, heard_clocks: Sequence[int]) -> bytes:
    if clock_ms is None:
        if heard_clocks:
            raise ValueError("heartbeat: expected the sender's clock beside those of heard boots, found none")
        return _NO_EXTENSION
    fields = b"".join((_CLOCK.pack(clock_ms), *(clock.to_bytes(HEARD_CLOCK_BYTES, "big") for clock in heard_clocks)))
    return bytes((len(fields),)) + fields


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
    plain = decode_plain(data)
    if plain is not None:
        return [plain]
    reader = Reader(data)
    frames: list[Frame] = []
    while reader.remaining():
        if len(frames) == limits.MAX_FRAMES_PER_DATAGRAM:
            raise DecodeError(f"datagram: expected at most {limits.MAX_FRAMES_PER_DATAGRAM} frames, found more")
        first = reader.integer(1, "frame type")
        if first & FRAGMENT:
            frames.append(decode_fragment(first, reader))
            continue
        decoder = _DECODERS.get(first)
        if decoder is None:
            raise DecodeError(f"frame type: expected {min(Type)}-{max(Type)} or a fragment, found {first}")
        frames.append(decoder(reader))
    if not frames:
        raise DecodeError("datagram: expected a frame, found none")
    return frames


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
    heard_clocks = _decode_heard_clocks(extension, count)
    return Heartbeat(
        name, low, high, features, interval_ms, known, rate, number, messages, heard, waiting, clock_ms, heard_clocks
    )


def _decode_heard_clocks(extension: bytes | memoryview, heard: int) -> tuple[int, ...]:
    """Whole clocks, at most one per heard boot; what follows them is of a later version."""
    count = min(heard, max(0, len(extension) - _CLOCK.size) // HEARD_CLOCK_BYTES)
    places = range(_CLOCK.size, _CLOCK.size + count * HEARD_CLOCK_BYTES, HEARD_CLOCK_BYTES)
    return tuple([int.from_bytes(extension[at : at + HEARD_CLOCK_BYTES], "big") for at in places])


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
    delay_us = reader.integer(3, "acknowledgment delay")
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
