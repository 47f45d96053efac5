"""A version and its base -> the body on the wire: the smaller of the difference and the whole.

The hash is computed first, then the difference, each in steps of about a millisecond. Before the first step of a
difference, zstd copies and indexes the base, which takes many: of a large base, that is done in the background. An
encoding that depends on nothing but the version and its base is shared by all peers that have this base.
"""

from __future__ import annotations

from collections.abc import Callable
from hashlib import blake2b
from typing import NamedTuple

from udp_mesh.core.interfaces import Background, in_foreground
from udp_mesh.core.zstd import ZstdCompression
from udp_mesh.wire.frames import MessageFlag
from udp_mesh.wire.version import HASH_BYTES, NO_BASE, VersionHeader, base_of, encode_version

HASH_STEP_BYTES = 1 << 19
"""Hashed per step: half a millisecond."""

MIN_COMPRESSED_BYTES = 128
"""Shorter versions gain nothing over zstd's own header."""


MIN_BASE_BYTES = 32
"""Shorter versions are never a base: they save nothing, and zstd refuses a prefix below 8 bytes."""


BACKGROUND_FROM_BYTES = 1 << 19
"""Copying and indexing a base of this size takes a millisecond."""


ENTRY_BYTES = 300
"""Overhead of a version that is kept, so that limits cover tiny ones, too."""


class Version(NamedTuple):
    """A version that a peer has."""

    digest: bytes
    payload: bytes

    @property
    def kept_bytes(self) -> int:
        """The memory that it takes."""
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

    __slots__ = (
        *("_at", "_background", "_base", "_begun", "_beginning", "_compressing", "_compression", "_hash", "_payload"),
        "result",
    )

    def __init__(
        self, payload: bytes, base: Version | None, *, compression: bool, background: Background = in_foreground
    ) -> None:
        self._payload = payload
        self._base = base
        self._compression = compression
        self._hash = blake2b(digest_size=HASH_BYTES)
        self._at = 0
        self._background = background
        self._beginning: _Beginning | None = None
        self._begun: Callable[[], bool] = _always
        self._compressing: ZstdCompression | None = None
        self.result: Encoded | None = None

    @property
    def is_waiting(self) -> bool:
        """Whether the next step is not possible yet."""
        return not self._begun()

    def step(self) -> bool:
        """Do one step. True when done."""
        payload = self._payload
        if self._at < len(payload):
            self._hash.update(memoryview(payload)[self._at : self._at + HASH_STEP_BYTES])
            self._at += HASH_STEP_BYTES
            if self._at < len(payload):
                return False
        if self._beginning is not None:
            return self._continue(self._beginning)
        if self._compressing is None:
            if self._base is None and not (self._compression and len(payload) >= MIN_COMPRESSED_BYTES):
                return self._finish(None)
            prefix = None if self._base is None else self._base.payload
            if prefix is not None and len(prefix) >= BACKGROUND_FROM_BYTES:
                self._beginning = _Beginning(payload, prefix)
                self._begun = self._background(self._beginning)
                return False
            self._compressing = ZstdCompression(payload, len(payload), prefix)
        return self._compressing.step() and self._finish(self._compressing.body)

    def _continue(self, beginning: _Beginning) -> bool:
        """After the step that was done in the background."""
        if self.is_waiting:
            return False
        self._beginning, self._compressing = None, beginning.compression
        if self._compressing is None:
            # It failed, for lack of memory: the whole goes out.
            return self._finish(None)
        return beginning.is_done and self._finish(self._compressing.body)

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


class _Beginning:
    """The first step of a difference, which copies and indexes the base. Touches nothing else."""

    def __init__(self, payload: bytes, prefix: bytes) -> None:
        self._payload = payload
        self._prefix = prefix
        self.compression: ZstdCompression | None = None
        """None until the step is done."""
        self.is_done = False
        """Whether it was also the last step."""

    def __call__(self) -> None:
        compression = ZstdCompression(self._payload, len(self._payload), self._prefix)
        self.is_done = compression.step()
        self.compression = compression


def _always() -> bool:
    return True


def encode(payload: bytes, base: Version | None, *, compression: bool) -> Encoded:
    """All steps at once."""
    encoding = VersionEncoding(payload, base, compression=compression)
    while not encoding.step():
        pass
    assert encoding.result is not None
    return encoding.result
