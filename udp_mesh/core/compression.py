"""Message bodies, compressed on request of their topic and never inflated past the receiver's limit."""

import zlib

LEVEL = 1
"""zlib's fastest: an embedded core compresses several times faster than a mesh carries."""

LEAST_BYTES = 128
"""Shorter messages gain nothing over zlib's own header."""


def compress(payload: bytes) -> bytes | None:
    """The payload as zlib (RFC 1950), or None where that is not shorter."""
    if len(payload) < LEAST_BYTES:
        return None
    packed = zlib.compress(payload, LEVEL)
    return packed if len(packed) < len(payload) else None


def decompress(body: bytes, limit_bytes: int) -> bytes | None:
    """The inverse; None for what is not zlib, is cut short, carries a tail, or grows past `limit_bytes`."""
    inflater = zlib.decompressobj()
    try:
        payload = inflater.decompress(body, limit_bytes + 1)
    except zlib.error:
        return None
    if len(payload) > limit_bytes or not inflater.eof or inflater.unused_data:
        return None
    return payload
