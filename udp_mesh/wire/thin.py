"""Frames of thin links (serial lines, XBee, LoRa): a header of 4 bytes, sealed items, a tag of 4 bytes.

    short         key hint (1) | sender's number (1) | low 16 bits of the counter (2) | sealed items | tag (4)
    introduction  the same with bit 7 of the first byte set, then boot tag (8) | high 16 bits of the counter (2)

Items follow each other until the end of the frame. A receiver that does not know a sender's boot can open only
introductions. Fields have passed their caps when a decoder returns them; constructors check nothing.
"""

from __future__ import annotations

import struct
from hashlib import blake2b
from typing import NamedTuple, TypeAlias

from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import (
    HEARD_TAG_BYTES,
    MAX_NAME_BYTES,
    MAX_THIN_HEARD,
    MAX_THIN_ITEMS,
    MAX_THIN_NUMBER,
    MAX_THIN_PARTS,
    MAX_TYPE_BYTES,
    PRIORITY_LEVELS,
)

THIN_VERSION = 1

INTRODUCTION_BIT = 0x80
HINT_MASK = 0x7F

THIN_TAG_BYTES = 4
"""Of AES-CCM: one forged frame in 2**32 is accepted, so receivers limit the number of attempts."""

_SHORT = struct.Struct(">BBH")
_INTRODUCTION = struct.Struct(f">BBH{HEARD_TAG_BYTES}sH")

SHORT_HEADER_BYTES = _SHORT.size
THIN_OVERHEAD_BYTES = SHORT_HEADER_BYTES + THIN_TAG_BYTES
"""Overhead of a frame, besides its items."""
INTRODUCTION_BYTES = _INTRODUCTION.size - _SHORT.size
"""Additional overhead of an introduction."""

_PRESENCE, _COMPLETE, _INCOMPLETE = 0x01, 0x02, 0x03
_PART = 0x80
_PART_RELIABLE, _PART_TO_ONE, _PART_OF_MANY = 0x40, 0x20, 0x10
_PRIORITY_MASK = PRIORITY_LEVELS - 1

ACK_BYTES = 4
PARTIAL_ACK_BYTES = 8
PART_BYTES = 9
"""Largest header of a part of an item: type, message, destination, position and parts, topic, length."""
PRESENCE_BYTES = 5
"""Of a presence, besides the name and the nodes that are heard."""
HEARD_BYTES = 5


class ThinHeader(NamedTuple):
    """The clear beginning of a frame. `boot_tag` and `counter_high` are None in a short one."""

    hint: int
    number: int
    counter_low: int
    boot_tag: bytes | None
    counter_high: int | None
    length: int
    """Bytes of the header, which are the associated data of the seal."""


class HeardFrom(NamedTuple):
    """The tag of the newest introduction that the sender of this item has opened from a node."""

    number: int
    token: bytes


class ThinPresence(NamedTuple):
    """The sender's name and the nodes it hears; only in introductions."""

    name: str
    interval_s: int
    """Longest time until its next one."""
    heard: tuple[HeardFrom, ...] = ()


class ThinAck(NamedTuple):
    """The parts of a message of node `number` that arrived: all (`parts` None), or the parts whose bits are set."""

    number: int
    message: int
    parts: int | None = None


class Part(NamedTuple):
    """A part of a message: all of it (`parts` 1), or the one at this position. The parts joined are a `ThinBody`."""

    message: int
    """Numbers the sender's messages modulo 2**16, from a random number on."""
    priority: int
    reliable: bool
    """Receivers that it is for acknowledge it."""
    destination: int | None
    """The node it is for; None: all."""
    position: int
    parts: int
    topic: bytes | None
    """`topic_hash`; only in the part at position 0."""
    data: bytes


ThinItem: TypeAlias = ThinPresence | ThinAck | Part


class ThinBody(NamedTuple):
    """A whole message."""

    type_name: str
    payload: bytes


def encode_header(hint: int, number: int, counter: int, boot_tag: bytes | None) -> bytes:
    """The header of a frame; with a boot tag, of an introduction."""
    low = counter & 0xFFFF
    if boot_tag is None:
        return _SHORT.pack(hint & HINT_MASK, number, low)
    return _INTRODUCTION.pack(hint & HINT_MASK | INTRODUCTION_BIT, number, low, boot_tag, counter >> 16)


def decode_header(frame: bytes | memoryview) -> ThinHeader:
    """The header. Raises `DecodeError`; the length of what follows is checked as well."""
    if len(frame) < THIN_OVERHEAD_BYTES:
        raise DecodeError(f"thin frame: expected at least {THIN_OVERHEAD_BYTES} bytes, found {len(frame)}")
    first, number, low = _SHORT.unpack_from(frame)
    if not 1 <= number <= MAX_THIN_NUMBER:
        raise DecodeError(f"thin frame: expected a number of 1 to {MAX_THIN_NUMBER}, found {number}")
    if not first & INTRODUCTION_BIT:
        return ThinHeader(first, number, low, None, None, SHORT_HEADER_BYTES)
    if len(frame) < THIN_OVERHEAD_BYTES + INTRODUCTION_BYTES:
        raise DecodeError(f"thin introduction: found {len(frame)} bytes")
    _, _, _, boot_tag, high = _INTRODUCTION.unpack_from(frame)
    return ThinHeader(first & HINT_MASK, number, low, boot_tag, high, _INTRODUCTION.size)


def encode_item(item: ThinItem) -> bytes:
    """One item. Raises ValueError for what its caps forbid (a mistake of the caller)."""
    match item:
        case ThinPresence(name, interval_s, heard):
            entries = b"".join(bytes((number,)) + token for number, token in heard)
            head = bytes((_PRESENCE, THIN_VERSION, interval_s))
            return head + encode_text(name, MAX_NAME_BYTES, "name") + bytes((len(heard),)) + entries
        case ThinAck(number, message, None):
            return bytes((_COMPLETE, number)) + message.to_bytes(2, "big")
        case ThinAck(number, message, int(parts)):
            return bytes((_INCOMPLETE, number)) + message.to_bytes(2, "big") + parts.to_bytes(4, "big")
        case Part():
            return _encode_part(item)
    raise TypeError(f"not an item: {item!r}")


def _encode_part(part: Part) -> bytes:
    many = part.parts > 1
    first = _PART | part.priority | _PART_RELIABLE * part.reliable | _PART_OF_MANY * many
    out = bytearray((first | _PART_TO_ONE * (part.destination is not None),))
    out += part.message.to_bytes(2, "big")
    if part.destination is not None:
        out.append(part.destination)
    if many:
        out += bytes((part.position, part.parts))
    if part.topic is not None:
        out += part.topic
    out.append(len(part.data))
    return bytes(out + part.data)


def decode_items(plain: bytes) -> list[ThinItem]:
    """All items of an opened frame. Raises `DecodeError`."""
    reader = Reader(plain)
    items: list[ThinItem] = []
    while reader.remaining():
        if len(items) >= MAX_THIN_ITEMS:
            raise DecodeError(f"thin frame: expected at most {MAX_THIN_ITEMS} items")
        kind = reader.integer(1, "item")
        if kind & _PART:
            items.append(_decode_part(kind, reader))
        elif kind == _PRESENCE:
            items.append(_decode_presence(reader))
        elif kind in (_COMPLETE, _INCOMPLETE):
            number, message = _number(reader), reader.integer(2, "message")
            items.append(ThinAck(number, message, reader.integer(4, "parts") if kind == _INCOMPLETE else None))
        else:
            raise DecodeError(f"thin frame: unknown item {kind:#04x}")
    return items


def _number(reader: Reader) -> int:
    number = reader.at_most(1, MAX_THIN_NUMBER, "number")
    if number == 0:
        raise DecodeError("thin frame: expected a number of at least 1, found 0")
    return number


def _decode_presence(reader: Reader) -> ThinPresence:
    version = reader.integer(1, "version")
    if version != THIN_VERSION:
        raise DecodeError(f"presence: expected version {THIN_VERSION}, found {version}")
    interval_s = reader.integer(1, "interval")
    name = reader.name(MAX_NAME_BYTES, "name")
    if "/" in name:
        raise DecodeError(f"presence: expected a name without slashes, found {name!r}")
    count = reader.at_most(1, MAX_THIN_HEARD, "heard nodes")
    heard = tuple(HeardFrom(_number(reader), bytes(reader.take(THIN_TAG_BYTES, "token"))) for _ in range(count))
    return ThinPresence(name, interval_s, heard)


def _decode_part(kind: int, reader: Reader) -> Part:
    message = reader.integer(2, "message")
    destination = _number(reader) if kind & _PART_TO_ONE else None
    position, parts = 0, 1
    if kind & _PART_OF_MANY:
        position, parts = reader.integer(1, "position"), reader.at_most(1, MAX_THIN_PARTS, "parts")
        if not position < parts or parts < 2:
            raise DecodeError(f"part: expected a position below a number of at least 2, found {position} of {parts}")
    topic = None if position else bytes(reader.take(TOPIC_HASH_BYTES, "topic"))
    data = bytes(reader.take(reader.integer(1, "length"), "data"))
    return Part(message, kind & _PRIORITY_MASK, bool(kind & _PART_RELIABLE), destination, position, parts, topic, data)


TOPIC_HASH_BYTES = 2
"""Distinguishes the few topics that thin links carry; a node refuses settings in which two are equal."""


def encode_body(body: ThinBody) -> bytes:
    """A message as its parts carry it. Raises ValueError for a type name that is too long."""
    return encode_text(body.type_name, MAX_TYPE_BYTES, "type") + body.payload


def decode_body(joined: bytes) -> ThinBody:
    """The message of its joined parts. Raises `DecodeError`."""
    reader = Reader(joined)
    return ThinBody(reader.text(MAX_TYPE_BYTES, "type"), bytes(reader.take(reader.remaining(), "payload")))


def topic_hash(name: str) -> bytes:
    """The beginning of BLAKE2b (RFC 7693) with 2 bytes over the topic's name."""
    return blake2b(name.encode(), digest_size=TOPIC_HASH_BYTES).digest()
