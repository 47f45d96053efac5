"""The body of a version -> the version, in steps. A result with another hash is none: no wrong byte is delivered."""

from __future__ import annotations

from hashlib import blake2b

from udp_mesh.core.versions.encoding import HASH_STEP_BYTES, Version
from udp_mesh.core.zstd import ZstdDecompression
from udp_mesh.wire.version import HASH_BYTES, VersionHeader


class VersionDecoding:
    """One version being decoded. When done, `payload` is None if the content is damaged, exceeds the limit, or does not
    have the stated hash; with a base, that may also mean that the base is damaged."""

    __slots__ = ("_at", "_content", "_decompressed", "_decompression", "_hash", "_result", "base", "header", "payload")

    def __init__(
        self, header: VersionHeader, content: memoryview, base: Version | None, limit_bytes: int, *, compressed: bool
    ) -> None:
        self.header = header
        self.base = base
        self._content = content
        self._hash = blake2b(digest_size=HASH_BYTES)
        self._at = 0
        self._decompressed = not compressed
        self._result: bytes | None = None
        self._decompression: ZstdDecompression | None = None
        if compressed:
            self._decompression = ZstdDecompression(content, limit_bytes, None if base is None else base.payload)
        elif base is None and len(content) <= limit_bytes:
            self._result = bytes(content)
        self.payload: bytes | None = None

    @property
    def held_bytes(self) -> int:
        """Size of the body and of what was decompressed so far."""
        if self._decompression is not None:
            return self._decompression.held_bytes
        return len(self._content) + (0 if self._result is None else len(self._result))

    def step(self) -> bool:
        """Do one step. True when done."""
        if not self._decompressed:
            assert self._decompression is not None
            if not self._decompression.step():
                return False
            self._decompressed = True
            self._result = self._decompression.payload
        if self._result is None:
            return True
        self._hash.update(memoryview(self._result)[self._at : self._at + HASH_STEP_BYTES])
        self._at += HASH_STEP_BYTES
        if self._at < len(self._result):
            return False
        if self._hash.digest() == self.header.digest:
            self.payload = self._result
        return True
