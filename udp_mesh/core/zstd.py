"""Zstandard (RFC 8878) in steps of about a millisecond, optionally with other bytes as the prefix of the content.

The module is part of Python from 3.14 on, and `backports.zstd` before. A Python without either still runs a node: it
announces neither `Feature.ZSTD` nor `Feature.VERSIONS`, and its peers send it something else.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from backports import zstd
else:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError:
        zstd = None

AVAILABLE = zstd is not None

LEVEL = 3
"""zstd's default."""

STEP_BYTES = 1 << 16
"""Compressed per step: a millisecond at most, except that the first step also indexes the prefix (1 to 4 ms per MB)."""

DECOMPRESS_STEP_BYTES = 1 << 18
"""Decompressed per step."""

LONG_DISTANCE_FROM_BYTES = 1 << 18
"""From this size of prefix and content on, matches farther away than the level's window are searched, too."""

MIN_WINDOW_LOG, MAX_WINDOW_LOG = 10, 27
"""Limits of zstd's window: a decoder allocates no more than 128 MiB for it, and no more than the content's size."""


def _window_log(size: int) -> int:
    return min(MAX_WINDOW_LOG, max(MIN_WINDOW_LOG, size.bit_length()))


class ZstdCompression:
    """Content being compressed into one frame. When done, `body` is None if it would have `limit_bytes` or more."""

    __slots__ = ("_at", "_compressor", "_content", "_limit_bytes", "_packed", "_size", "body")

    def __init__(self, content: bytes, limit_bytes: int, prefix: bytes | None = None) -> None:
        self._content = memoryview(content)
        self._limit_bytes = limit_bytes
        self._compressor = _compressor(len(content), prefix)
        self._packed: list[bytes] = []
        self._size = 0
        self._at = 0
        self.body: bytes | None = None

    def step(self) -> bool:
        """Compress one step. True when done."""
        end = self._at + STEP_BYTES
        last = end >= len(self._content)
        packed = self._compressor.compress(
            self._content[self._at : end], zstd.ZstdCompressor.FLUSH_FRAME if last else zstd.ZstdCompressor.CONTINUE
        )
        self._packed.append(packed)
        self._size += len(packed)
        self._at = end
        if self._size >= self._limit_bytes:
            return True
        if last:
            self.body = b"".join(self._packed)
        return last


def _compressor(size: int, prefix: bytes | None) -> zstd.ZstdCompressor:
    parameter = zstd.CompressionParameter
    options = {int(parameter.compression_level): LEVEL}
    if prefix is None:
        compressor = zstd.ZstdCompressor(options=options)
    else:
        total = size + len(prefix)
        options[parameter.window_log] = _window_log(total)
        options[parameter.enable_long_distance_matching] = int(total >= LONG_DISTANCE_FROM_BYTES)
        dictionary = zstd.ZstdDict(prefix, is_raw=True)
        compressor = zstd.ZstdCompressor(options=options, zstd_dict=dictionary.as_prefix)
    compressor.set_pledged_input_size(size)
    return compressor


class ZstdDecompression:
    """A frame being decompressed. When done, `payload` is None if it is damaged, truncated, followed by other bytes,
    does not state its content's size, or that exceeds the limit."""

    __slots__ = ("_at", "_body", "_decompressor", "_parts", "_size", "held_bytes", "payload")

    def __init__(self, body: bytes | memoryview, limit_bytes: int, prefix: bytes | None = None) -> None:
        self._body = memoryview(body)
        self._parts: list[bytes] = []
        self._at = 0
        self.held_bytes = len(body)
        """Size of the body and of what was decompressed so far."""
        self.payload: bytes | None = None
        self._size = -1
        self._decompressor: zstd.ZstdDecompressor | None = None
        try:
            stated = zstd.get_frame_info(bytes(self._body[:32])).decompressed_size
        except (zstd.ZstdError, ValueError):
            return
        if stated is None or stated > limit_bytes:
            return
        self._size = stated
        self._decompressor = _decompressor(stated, prefix)

    def step(self) -> bool:
        """Decompress one step. True when done."""
        decompressor = self._decompressor
        if decompressor is None:
            return True
        room = DECOMPRESS_STEP_BYTES
        while room > 0:
            source = b""
            if decompressor.needs_input:
                source = bytes(self._body[self._at : self._at + STEP_BYTES])
                if not source:
                    # Truncated.
                    return True
                self._at += len(source)
            try:
                part = decompressor.decompress(source, room)
            except (zstd.ZstdError, EOFError, MemoryError):
                return True
            room -= len(part)
            self._parts.append(part)
            self.held_bytes += len(part)
            if self.held_bytes - len(self._body) > self._size:
                return True
            if decompressor.eof:
                whole = self.held_bytes - len(self._body) == self._size
                if whole and not decompressor.unused_data and self._at >= len(self._body):
                    self.payload = b"".join(self._parts)
                return True
        return False


def _decompressor(size: int, prefix: bytes | None) -> zstd.ZstdDecompressor:
    total = size if prefix is None else size + len(prefix)
    # A window below 8 MiB costs little, and a compressor may choose one larger than its content.
    options = {int(zstd.DecompressionParameter.window_log_max): max(23, _window_log(total))}
    if prefix is None:
        return zstd.ZstdDecompressor(options=options)
    return zstd.ZstdDecompressor(zstd_dict=zstd.ZstdDict(prefix, is_raw=True).as_prefix, options=options)
