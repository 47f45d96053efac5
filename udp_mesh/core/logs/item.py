"""One item of a log, as its source signed it: fields and payload -> bytes -> fields, verified.

    version 1 | source (text, 1+n) | log id 32 | number 8 | creation time 8 (ms of Unix time) | type (text, 1+n)
    | signature 64 | payload (the rest)

The signature covers the topic and every field before and after it, so that an item cannot be moved to another topic,
source or number.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import NamedTuple

from udp_mesh.crypto.signing import PUBLIC_KEY_BYTES, SIGNATURE_BYTES, SigningKey, is_signed
from udp_mesh.wire.buffer import Reader, encode_text
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.limits import MAX_NAME_BYTES, MAX_TYPE_BYTES

ITEM_VERSION = 1
FIRST_NUMBER = 1
MAX_NUMBER = (1 << 48) - 1
"""A million items a second for nine years."""
_NUMBERS = struct.Struct(">QQ")
_SIGNED_AS = b"udp_mesh log item 1"


class LogKey(NamedTuple):
    """Names one source's numbering within one topic. A source that lost its disk begins a new log, with a new
    `log_id`."""

    topic: str
    source: str
    log_id: bytes
    """The public key (Ed25519, 32 bytes) that verifies the items."""


class ItemId(NamedTuple):
    """Identifies one item in the whole fleet."""

    log: LogKey
    number: int


@dataclass(frozen=True, slots=True)
class LogItem:
    """A verified item."""

    id: ItemId
    created_ms: int
    """Creation time by the source's clock, in milliseconds since 1970: for display only."""
    type_name: str
    payload: bytes


def encode_item(key: SigningKey, item: LogItem) -> bytes:
    """The signed bytes. Raises ValueError if `key` is not the log's."""
    if key.public != item.id.log.log_id:
        raise ValueError("the key does not belong to the item's log")
    head = _head(item)
    return head + key.sign(_signed(item.id.log.topic, head, item.payload)) + item.payload


def decode_item(topic: str, data: bytes | memoryview) -> LogItem:
    """The item in these bytes. Raises DecodeError if they are malformed or its source did not sign them."""
    reader = Reader(data)
    version = reader.integer(1, "item version")
    if version != ITEM_VERSION:
        raise DecodeError(f"item version: expected {ITEM_VERSION}, found {version}")
    source = reader.name(MAX_NAME_BYTES, "source")
    log_id = bytes(reader.take(PUBLIC_KEY_BYTES, "log id"))
    number, created_ms = _NUMBERS.unpack(reader.take(_NUMBERS.size, "number and creation time"))
    if not FIRST_NUMBER <= number <= MAX_NUMBER:
        raise DecodeError(f"item number: expected {FIRST_NUMBER} to {MAX_NUMBER}, found {number}")
    type_name = reader.text(MAX_TYPE_BYTES, "type")
    head = bytes(memoryview(data)[: reader.position])
    signature = bytes(reader.take(SIGNATURE_BYTES, "signature"))
    payload = bytes(reader.take(reader.remaining(), "payload"))
    if not is_signed(log_id, signature, _signed(topic, head, payload)):
        raise DecodeError(f"item {number} of {source}: expected its source's signature, found another")
    return LogItem(ItemId(LogKey(topic, source, log_id), number), created_ms, type_name, payload)


def _head(item: LogItem) -> bytes:
    log = item.id.log
    return b"".join(
        (
            bytes((ITEM_VERSION,)),
            encode_text(log.source, MAX_NAME_BYTES, "source"),
            log.log_id,
            _NUMBERS.pack(item.id.number, item.created_ms),
            encode_text(item.type_name, MAX_TYPE_BYTES, "type"),
        )
    )


def _signed(topic: str, head: bytes, payload: bytes) -> bytes:
    name = topic.encode()
    return b"".join((_SIGNED_AS, bytes((len(name),)), name, head, payload))
