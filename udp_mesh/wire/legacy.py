"""The legacy format (docs/facts/legacy-wire.md): datagrams with one-byte types, messages as serialized
`PriorityMeshData`.

Datagram -> `Host`, `Payload`, `LegacyAck` or `PayloadNoAck`; the payloads of one message, in order ->
`PriorityMeshData`. Both directions, so that nodes of either kind can share a fleet during an upgrade. Nothing in this
format is authenticated: a reader must trust the address, not the name. Little-endian throughout, unlike the rest of
`wire`.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeAlias, assert_never

from udp_mesh.wire.buffer import decode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import (
    MAX_LEGACY_FRAGMENT_BYTES,
    MAX_LEGACY_FRAGMENTS,
    MAX_NAME_BYTES,
    MAX_TOPIC_BYTES,
    MAX_TYPE_BYTES,
)

_HEADER = struct.Struct("<BHIIH")
LEGACY_OVERHEAD_BYTES = _HEADER.size + 1
"""Header and the trailing byte of a disabled checksum."""
LAST_SEQUENCE = 0x7FFF
"""Unicast sequence numbers run from 1 to this, then from 1 again."""
_HOST = struct.Struct("<64p16p")
_NAME_CAPACITY_BYTES = 63
_ADDRESS_CAPACITY_BYTES = 15


_ROS_NAME = re.compile(r"[A-Za-z/][A-Za-z0-9_/]*")
_ROS_TYPE = re.compile(r"[A-Za-z][A-Za-z0-9_]*/[A-Za-z][A-Za-z0-9_]*")


def is_ros_name(name: str) -> bool:
    """Whether ROS 1 accepts this as a topic name (wiki.ros.org/Names), relative or global."""
    return _ROS_NAME.fullmatch(name) is not None and "//" not in name and name.strip("/") != ""


def is_ros_type(name: str) -> bool:
    """Whether this is the name of a ROS 1 message type, `pkg/Type`."""
    return _ROS_TYPE.fullmatch(name) is not None


class LegacyType(IntEnum):
    PAYLOAD = 1
    ACK = 2
    HOST = 4
    PAYLOAD_NOACK = 5


@dataclass(frozen=True, slots=True)
class Host:
    """Heartbeat, once a second: a name and a dotted IPv4 address, both as claimed."""

    name: str
    address: str


@dataclass(frozen=True, slots=True)
class LegacyPayload:
    """A fragment; `wants_ack` distinguishes PAYLOAD from PAYLOAD_NOACK (broadcast)."""

    sequence: int
    position: int
    total: int
    data: bytes
    wants_ack: bool


@dataclass(frozen=True, slots=True)
class LegacyAck:
    """Acknowledges one fragment."""

    sequence: int
    position: int


LegacyDatagram: TypeAlias = Host | LegacyPayload | LegacyAck


@dataclass(frozen=True, slots=True)
class PriorityMeshData:
    """The message that the legacy system reassembles: opaque user bytes with their topic, type and priority."""

    host: str
    type_name: str
    priority: int
    """0 (most urgent) to 255."""
    topic: str
    data: bytes
    sequence: int = 0
    stamp_s: int = 0
    stamp_ns: int = 0
    frame_id: str = ""


_ENCAPSULATION = _HEADER.pack(LegacyType.ACK, 0xFFFF, 0xFFFFFFFF, 0, 0)[:-2]
"""An acknowledgment of a message that is never sent: unicast numbers end at 0x7fff, and broadcasts are not
acknowledged."""


def encapsulate(data: bytes) -> bytes:
    """Encapsulate a datagram that may reach legacy programs in the payload of an acknowledgment they ignore.

    A legacy program that receives a datagram of an unknown type, as by broadcast, crashes.
    """
    return _ENCAPSULATION + struct.pack("<H", len(data)) + data + b"\x00"


def decapsulate(data: bytes | memoryview) -> bytes | memoryview | None:
    """The datagram passed to `encapsulate`; None for anything else."""
    if len(data) < LEGACY_OVERHEAD_BYTES or bytes(data[: len(_ENCAPSULATION)]) != _ENCAPSULATION:
        return None
    return data[_HEADER.size : -1]


def is_legacy(data: bytes | memoryview) -> bool:
    """Whether the first byte is a type of the legacy format."""
    return len(data) >= LEGACY_OVERHEAD_BYTES and data[0] in (1, 2, 4, 5)


def encode_legacy(datagram: LegacyDatagram) -> bytes:
    """Raises ValueError for a value the format cannot carry."""
    match datagram:
        case Host(name, address):
            raw_name, raw_address = name.encode(), address.encode()
            if not 0 < len(raw_name) <= _NAME_CAPACITY_BYTES or not 0 < len(raw_address) <= _ADDRESS_CAPACITY_BYTES:
                raise ValueError(f"legacy heartbeat: {name!r} at {address!r} does not fit its fields")
            return _frame(LegacyType.HOST, 0, 0, 0, _HOST.pack(raw_name, raw_address))
        case LegacyPayload(sequence, position, total, data, wants_ack):
            if len(data) > MAX_LEGACY_FRAGMENT_BYTES or not 0 <= position < total <= MAX_LEGACY_FRAGMENTS:
                raise ValueError(f"legacy fragment {position} of {total} with {len(data)} bytes")
            kind = LegacyType.PAYLOAD if wants_ack else LegacyType.PAYLOAD_NOACK
            return _frame(kind, sequence, position, total, data)
        case LegacyAck(sequence, position):
            return _frame(LegacyType.ACK, sequence, position, 0, b"")
        case _:
            assert_never(datagram)


def _frame(kind: LegacyType, sequence: int, position: int, total: int, data: bytes) -> bytes:
    return _HEADER.pack(kind, sequence, position, total, len(data)) + data + b"\x00"


def decode_legacy(raw: bytes | memoryview) -> LegacyDatagram:
    """Raises DecodeError for anything else. The trailing checksum byte is ignored, as by the legacy receiver."""
    if len(raw) < LEGACY_OVERHEAD_BYTES:
        raise DecodeError(f"legacy datagram: expected {LEGACY_OVERHEAD_BYTES} bytes or more, found {len(raw)}")
    kind, sequence, position, total, length = _HEADER.unpack_from(raw)
    data = bytes(raw[_HEADER.size : _HEADER.size + length])
    if len(raw) != LEGACY_OVERHEAD_BYTES + length:
        raise DecodeError(f"legacy datagram: expected {LEGACY_OVERHEAD_BYTES + length} bytes, found {len(raw)}")
    if kind in (LegacyType.PAYLOAD, LegacyType.PAYLOAD_NOACK):
        if length > MAX_LEGACY_FRAGMENT_BYTES:
            raise DecodeError(f"legacy fragment: expected at most {MAX_LEGACY_FRAGMENT_BYTES} bytes, found {length}")
        if not position < total <= MAX_LEGACY_FRAGMENTS:
            raise DecodeError(f"legacy fragment: position {position} of {total} is out of range")
        return LegacyPayload(sequence, position, total, data, kind == LegacyType.PAYLOAD)
    if kind == LegacyType.ACK:
        return LegacyAck(sequence, position)
    if kind == LegacyType.HOST:
        if length != _HOST.size:
            raise DecodeError(f"legacy heartbeat: expected {_HOST.size} bytes, found {length}")
        raw_name, raw_address = _HOST.unpack(data)
        name, address = decode_text(raw_name, "legacy name"), decode_text(raw_address, "legacy address")
        if not name or "/" in name or " " in name:
            raise DecodeError(f"legacy name: expected a host name, found {name!r}")
        return Host(name, address)
    raise DecodeError(f"legacy type: expected 1, 2, 4 or 5, found {kind}")


def fragment_legacy(message: bytes) -> list[bytes]:
    """Split a message as the legacy receiver expects: `n // 1300 + 1` fragments, so an exact multiple ends with an
    empty one."""
    size = MAX_LEGACY_FRAGMENT_BYTES
    return [message[start : start + size] for start in range(0, len(message) // size * size + 1, size)]


def encode_mesh_data(message: PriorityMeshData) -> bytes:
    """ROS 1 serialization of `PriorityMeshData`. Raises ValueError for a priority outside 0 to 255."""
    if not 0 <= message.priority <= 255:
        raise ValueError(f"legacy priority: expected 0 to 255, found {message.priority}")
    return b"".join(
        (
            struct.pack("<III", message.sequence, message.stamp_s, message.stamp_ns),
            _string(message.frame_id.encode()),
            _string(message.host.encode()),
            _string(message.type_name.encode()),
            bytes((message.priority,)),
            _string(message.topic.encode()),
            _string(message.data),
        )
    )


def _string(raw: bytes) -> bytes:
    return struct.pack("<I", len(raw)) + raw


def decode_mesh_data(raw: bytes) -> PriorityMeshData:
    """The inverse of `encode_mesh_data`. Raises DecodeError, also for trailing bytes."""
    if len(raw) < 12:
        raise DecodeError(f"legacy message: expected a header of 12 bytes, found {len(raw)}")
    sequence, stamp_s, stamp_ns = struct.unpack_from("<III", raw)
    offset = 12
    frame_id, offset = _read_text(raw, offset, MAX_TOPIC_BYTES, "frame id")
    host, offset = _read_text(raw, offset, MAX_NAME_BYTES, "host")
    type_name, offset = _read_text(raw, offset, MAX_TYPE_BYTES, "type")
    if offset >= len(raw):
        raise DecodeError("legacy priority: expected 1 byte, found 0")
    priority = raw[offset]
    topic, offset = _read_text(raw, offset + 1, MAX_TOPIC_BYTES, "topic")
    data, offset = _read(raw, offset, len(raw), "data")
    if offset != len(raw):
        raise DecodeError(f"legacy message: {len(raw) - offset} trailing bytes")
    return PriorityMeshData(host, type_name, priority, topic, data, sequence, stamp_s, stamp_ns, frame_id)


def _read(raw: bytes, offset: int, limit_bytes: int, what: str) -> tuple[bytes, int]:
    if offset + 4 > len(raw):
        raise DecodeError(f"legacy {what}: expected a length of 4 bytes, found {len(raw) - offset}")
    length = int.from_bytes(raw[offset : offset + 4], "little")
    end = offset + 4 + length
    if length > limit_bytes or end > len(raw):
        raise DecodeError(f"legacy {what}: {length} bytes are more than {min(limit_bytes, len(raw) - offset - 4)}")
    return raw[offset + 4 : end], end


def _read_text(raw: bytes, offset: int, limit_bytes: int, what: str) -> tuple[str, int]:
    value, end = _read(raw, offset, limit_bytes, what)
    return decode_text(value, f"legacy {what}"), end
