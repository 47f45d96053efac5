"""A Zenoh sample <-> bytes: key, kind, quality of service, encoding, attachment, payload. Pure.

Big-endian: version u8 (1), flags u8, priority u8 (1 to 7, as in Zenoh), key length u16, encoding length u16, attachment
length u32, then key, encoding, attachment, payload. Payload and attachment are opaque: CDR and the attachment of
`rmw_zenoh` (sequence number, time, publisher) arrive unchanged.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

VERSION = 1
TYPE = "zenoh"
"""The mesh type field of these messages: other bridges ignore them, and this one ignores other types."""
_HEAD = struct.Struct(">BBBHHI")
_DELETE, _EXPRESS, _BLOCK, _ATTACHED, _AGAIN = 1, 2, 4, 8, 16
_FLAGS = _DELETE | _EXPRESS | _BLOCK | _ATTACHED | _AGAIN
PRIORITIES = range(1, 8)


class EnvelopeError(ValueError):
    """These bytes are not a valid sample."""


class Envelope(NamedTuple):
    """One sample. `block`: Zenoh waits instead of dropping under congestion; `attachment`: None differs from empty;
    `again`: sent again for a late joiner, so others may have it already."""

    key: str
    payload: bytes
    encoding: str
    attachment: bytes | None
    priority: int
    block: bool
    express: bool
    delete: bool
    again: bool = False


def seal(sample: Envelope) -> bytes:
    """Encodes a sample. Raises EnvelopeError if its key or encoding exceeds the format's limit."""
    key, encoding = sample.key.encode(), sample.encoding.encode()
    if len(key) > 0xFFFF or len(encoding) > 0xFFFF:
        raise EnvelopeError("key and encoding: expected at most 65535 bytes each")
    flags = (
        _DELETE * sample.delete
        | _EXPRESS * sample.express
        | _BLOCK * sample.block
        | _ATTACHED * (sample.attachment is not None)
        | _AGAIN * sample.again
    )
    attachment = sample.attachment or b""
    head = _HEAD.pack(VERSION, flags, sample.priority, len(key), len(encoding), len(attachment))
    return b"".join((head, key, encoding, attachment, sample.payload))


def open_envelope(data: bytes) -> Envelope:
    """Decodes a sample. Raises EnvelopeError."""
    if len(data) < _HEAD.size:
        raise EnvelopeError("expected at least {} bytes, found {}".format(_HEAD.size, len(data)))
    version, flags, priority, key_bytes, encoding_bytes, attachment_bytes = _HEAD.unpack_from(data)
    if version != VERSION or flags & ~_FLAGS or priority not in PRIORITIES:
        raise EnvelopeError("expected version 1, known flags and priority 1 to 7, found {}".format(data[:3].hex()))
    encoding_at = _HEAD.size + key_bytes
    attachment_at = encoding_at + encoding_bytes
    payload_at = attachment_at + attachment_bytes
    if payload_at > len(data) or not key_bytes or (attachment_bytes and not flags & _ATTACHED):
        raise EnvelopeError("field lengths do not match a total of {} bytes".format(len(data)))
    try:
        key = data[_HEAD.size : encoding_at].decode("utf-8")
        encoding = data[encoding_at:attachment_at].decode("utf-8")
    except UnicodeDecodeError as error:
        raise EnvelopeError("key or encoding is not valid UTF-8") from error
    if any(sign in key for sign in "*$?#"):
        raise EnvelopeError("expected one key, found the key expression {!r}".format(key))
    attachment = data[attachment_at:payload_at] if flags & _ATTACHED else None
    return Envelope(
        key,
        data[payload_at:],
        encoding,
        attachment,
        priority,
        bool(flags & _BLOCK),
        bool(flags & _EXPRESS),
        bool(flags & _DELETE),
        bool(flags & _AGAIN),
    )
