"""The beginning of the body of a message with `MessageFlag.VERSION`: which version it is, and of which one it is the
difference.

    base (4) | hash (8) | content

The hash of a version is BLAKE2b (RFC 7693) with 8 bytes over the bytes passed to `send`; `base` is the beginning of the
base's hash, or zero for a whole version. With `MessageFlag.COMPRESSED` the content is one zstd frame (RFC 8878) that
states its content size, with the base's bytes as its prefix if there is a base; otherwise it is the version itself.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import NamedTuple

from udp_mesh.wire.errors import DecodeError

BASE_BYTES = 4
"""Only to find the base among the few that a receiver holds: the hash of the result proves that it was the right one.
"""

HASH_BYTES = 8
"""Against damage and mistakes, not against forgery: the datagrams are authenticated."""

VERSION_HEADER_BYTES = BASE_BYTES + HASH_BYTES

NO_BASE = bytes(BASE_BYTES)
"""A whole version. A version whose hash begins like this is never a base."""


class VersionHeader(NamedTuple):
    base: bytes
    """`BASE_BYTES`; `NO_BASE` for a whole version."""
    digest: bytes
    """`HASH_BYTES`."""


def version_hash(payload: bytes) -> bytes:
    """The hash that identifies a version."""
    return blake2b(payload, digest_size=HASH_BYTES).digest()


def base_of(digest: bytes) -> bytes:
    """How a difference names its base."""
    return digest[:BASE_BYTES]


def encode_version(header: VersionHeader, content: bytes) -> bytes:
    """The body. Raises ValueError for a hash or base of another size (a mistake of the caller)."""
    if (len(header.base), len(header.digest)) != (BASE_BYTES, HASH_BYTES):
        raise ValueError(f"version: expected a base of {BASE_BYTES} and a hash of {HASH_BYTES} bytes")
    return b"".join((header.base, header.digest, content))


def decode_version(body: bytes) -> tuple[VersionHeader, memoryview]:
    """The header and a view of the content. Raises `DecodeError`."""
    if len(body) < VERSION_HEADER_BYTES:
        raise DecodeError(f"version: expected at least {VERSION_HEADER_BYTES} bytes, found {len(body)}")
    header = VersionHeader(bytes(body[:BASE_BYTES]), bytes(body[BASE_BYTES:VERSION_HEADER_BYTES]))
    return header, memoryview(body)[VERSION_HEADER_BYTES:]
