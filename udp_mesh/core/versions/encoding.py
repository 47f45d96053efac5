"""A version and its base -> the body on the wire: the smaller of the difference and the whole.

The hash is computed first, then the difference, each in steps of about a millisecond. An encoding that depends on
nothing but the version and its base is shared by all peers that have this base.
"""

from __future__ import annotations

from hashlib import blake2b
from typing import NamedTuple

from udp_mesh.core.zstd import ZstdCompression
from udp_mesh.wire.frames import MessageFlag
from udp_mesh.wire.version import HASH_BYTES, NO_BASE, VersionHeader, base_of, encode_version

HASH_STEP_BYTES = 1 << 19
"""Hashed per step: half a millisecond."""

MIN_COMPRESSED_BYTES = 128
"""Shorter versions gain nothing over zstd's own header."""


MIN_BASE_BYTES = 32
"""Shorter versions are never a base: they save nothing, and zstd refuses a prefix below 8 bytes."""


ENTRY_BYTES = 300
"""Overhead of a version that is kept, so that limits cover tiny ones, too."""


class Version(NamedTuple):
    """A version that a peer has."""

    digest: bytes
    payload: bytes

    @property
    def kept_bytes(self) -> int:
        """What it takes to keep it."""
        return len(self.payload) + ENTRY_BYTES


class Encoded(NamedTuple):
    """How a version is sent."""

    body: bytes
    flags: int
    """`MessageFlag.VERSION`, and those of its compression."""
    digest: bytes
    is_difference: bool


class VersionEncoding:
    """One version being encoded. `base` is None for a whole version, which is compressed if `compression`. When done,
    `result` is set."""

    __slots__ = ("_at", "_base", "_compressing", "_compression", "_hash", "_payload", "result")

    def __init__(self, payload: bytes, base: Version | None, *, compression: bool) -> None:
        self._payload = payload
        self._base = base
        self._compression = compression
        self._hash = blake2b(digest_size=HASH_BYTES)
        self._at = 0
        self._compressing: ZstdCompression | None = None
        self.result: Encoded | None = None

    def step(self) -> bool:
        """Do one step. True when done."""
        payload = self._payload
        if self._at < len(payload):
            self._hash.update(memoryview(payload)[self._at : self._at + HASH_STEP_BYTES])
            self._at += HASH_STEP_BYTES
            if self._at < len(payload):
                return False
        if self._compressing is None:
            if self._base is None and not (self._compression and len(payload) >= MIN_COMPRESSED_BYTES):
                return self._finish(None)
            prefix = None if self._base is None else self._base.payload
            self._compressing = ZstdCompression(payload, len(payload), prefix)
        return self._compressing.step() and self._finish(self._compressing.body)

    def _finish(self, packed: bytes | None) -> bool:
        digest = self._hash.digest()
        flags = MessageFlag.VERSION
        base = NO_BASE
        if packed is not None:
            flags |= MessageFlag.COMPRESSED | MessageFlag.ZSTD
            if self._base is not None:
                base = base_of(self._base.digest)
        body = encode_version(VersionHeader(base, digest), self._payload if packed is None else packed)
        self.result = Encoded(body, flags, digest, base != NO_BASE)
        return True


def encode(payload: bytes, base: Version | None, *, compression: bool) -> Encoded:
    """All steps at once."""
    encoding = VersionEncoding(payload, base, compression=compression)
    while not encoding.step():
        pass
    assert encoding.result is not None
    return encoding.result
