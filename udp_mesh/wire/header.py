"""The clear header in front of the sealed frames.

First byte: bit 7 set (so that it never looks like the legacy format, whose types are 1, 2, 4 and 5), bits 6-4 the wire
version, bits 3-0 the kind. Then either

- the long header (33 B: HELLO to all, INTRODUCTION to one peer that may not know us yet): key id (4), sender's boot id
  (16), packet number (8), check (4); or
- the short header (7 B: BROADCAST, DATA): channel tag (2), low 32 bits of the packet number (4).

The check is a short keyed hash of the long header: a flood of invented senders is dropped before any key is derived for
them. The tag is derived from the channel's key, so that only key holders can link it to a node.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

from udp_mesh.wire.errors import DecodeError, UnknownVersionError
from udp_mesh.wire.limits import MAX_DATAGRAM_BYTES

VERSION = 1
"""The only version written and read by this code; 3 bits on the wire."""

MARK = 0x80
"""Bit 7 of the first byte: not a legacy datagram."""


class Kind(IntEnum):
    HELLO = 0
    """To all, long header: discovery."""
    BROADCAST = 1
    """To all, short header: messages to all."""
    INTRODUCTION = 2
    """To one boot, long header: until the peer has answered in this channel."""
    DATA = 3
    """To one boot, short header."""


class LongHeader(NamedTuple):
    kind: Kind
    key_id: bytes
    boot_id: bytes
    number: int
    check: bytes


class ShortHeader(NamedTuple):
    kind: Kind
    tag: int
    number_low: int


SHORT_HEADER = struct.Struct(">BHI")
"""First byte, channel tag, low 32 bits of the packet number."""
_LONG = struct.Struct(">B4s16sQ4s")
SHORT_HEADER_BYTES = SHORT_HEADER.size
LONG_HEADER_BYTES = _LONG.size
CHECK_BYTES = 4
SEAL_TAG_BYTES = 16
"""Authentication tag that AES-128-GCM appends to the sealed frames."""

_HELLO_BYTE = MARK | VERSION << 4 | Kind.HELLO
BROADCAST_BYTE = MARK | VERSION << 4 | Kind.BROADCAST
_INTRODUCTION_BYTE = MARK | VERSION << 4 | Kind.INTRODUCTION
DATA_BYTE = MARK | VERSION << 4 | Kind.DATA
NUMBER_LOW_MASK = 0xFFFFFFFF


def encode_long(kind: Kind, key_id: bytes, boot_id: bytes, number: int) -> bytes:
    """The long header without its check, which `Key.check` computes."""
    return _LONG.pack(MARK | VERSION << 4 | kind, key_id, boot_id, number, b"")[:-CHECK_BYTES]


def parse_header(data: bytes | bytearray | memoryview) -> LongHeader | ShortHeader:
    """The header of a datagram.

    Raises `UnknownVersionError` for another version, `DecodeError` for a foreign datagram or one too short to be
    sealed.
    """
    size = len(data)
    if size < SHORT_HEADER_BYTES + SEAL_TAG_BYTES:
        raise DecodeError(f"datagram: expected at least {SHORT_HEADER_BYTES + SEAL_TAG_BYTES} bytes, found {size}")
    first = data[0]
    if first in (DATA_BYTE, BROADCAST_BYTE):
        _, tag, low = SHORT_HEADER.unpack_from(data)
        return ShortHeader(Kind.DATA if first == DATA_BYTE else Kind.BROADCAST, tag, low)
    if first < MARK:
        raise DecodeError(f"datagram: expected the mark bit, found first byte {first:#04x}")
    if (first >> 4) & 7 != VERSION:
        raise UnknownVersionError((first >> 4) & 7)
    if first not in (_HELLO_BYTE, _INTRODUCTION_BYTE):
        raise DecodeError(f"datagram: expected a kind 0-3, found {first & 15}")
    if size < LONG_HEADER_BYTES + SEAL_TAG_BYTES or size > MAX_DATAGRAM_BYTES:
        raise DecodeError(f"datagram: expected {LONG_HEADER_BYTES + SEAL_TAG_BYTES} bytes or more, found {size}")
    _, key_id, boot_id, number, check = _LONG.unpack_from(data)
    return LongHeader(Kind.HELLO if first == _HELLO_BYTE else Kind.INTRODUCTION, key_id, boot_id, number, check)
