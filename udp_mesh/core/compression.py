"""Compression of message bodies: on request of their topic, and never inflated beyond the receiver's limit.

Both directions run in steps of about a millisecond, so that a map of 20 MB blocks nothing else. `Compression` and
`Decompression` process one zlib body, `zstd` has the same for zstd, which is used if all receivers accept it;
`CompressionQueue` holds what a node has yet to compress.
"""

import zlib
from collections import deque
from dataclasses import dataclass

from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import TopicChannel
from udp_mesh.core.zstd import ZstdCompression, ZstdDecompression
from udp_mesh.wire.frames import MessageFlag

LEVEL = 1
"""zlib's fastest: an embedded core compresses several times faster than a mesh transmits."""

MIN_BYTES = 128
"""Shorter messages gain nothing over zlib's own header."""

STEP_BYTES = 1 << 16
"""Compressed per step: about a millisecond."""

INFLATE_STEP_BYTES = 1 << 18
"""Inflated per step; inflating is faster."""


class Compression:
    """A payload being compressed (zlib, RFC 1950). When done, `body` is None if it would not be shorter."""

    __slots__ = ("_at", "_compressor", "_packed", "_payload", "_size", "body")

    def __init__(self, payload: bytes) -> None:
        self._payload = memoryview(payload)
        self._compressor = zlib.compressobj(LEVEL)
        self._packed: list[bytes] = []
        self._size = 0
        self._at = 0
        self.body: bytes | None = None

    def step(self) -> bool:
        """Compress one step. True when done."""
        size = len(self._payload)
        if size < MIN_BYTES:
            return True
        self._add(self._compressor.compress(self._payload[self._at : self._at + STEP_BYTES]))
        self._at += STEP_BYTES
        if self._size >= size:
            return True
        if self._at < size:
            return False
        self._add(self._compressor.flush())
        if self._size < size:
            self.body = b"".join(self._packed)
        return True

    def _add(self, packed: bytes) -> None:
        self._packed.append(packed)
        self._size += len(packed)


class Decompression:
    """A body being inflated. When done, `payload` is None if the body is not zlib, is truncated, has trailing bytes, or
    exceeds the limit."""

    __slots__ = ("_at", "_body", "_inflater", "_limit_bytes", "_parts", "held_bytes", "payload")

    def __init__(self, body: bytes, limit_bytes: int) -> None:
        self._body = memoryview(body)
        self._limit_bytes = limit_bytes
        self._inflater = zlib.decompressobj()
        self._parts: list[bytes] = []
        self._at = 0
        self.held_bytes = len(body)
        """Size of the body and of what was inflated so far."""
        self.payload: bytes | None = None

    def step(self) -> bool:
        """Inflate one step. True when done."""
        inflater = self._inflater
        room = INFLATE_STEP_BYTES
        while room > 0:
            source = inflater.unconsumed_tail
            if not source:
                source = bytes(self._body[self._at : self._at + STEP_BYTES])
                self._at += len(source)
            try:
                part = inflater.decompress(source, room)
            except zlib.error:
                return True
            room -= len(part)
            self._parts.append(part)
            self.held_bytes += len(part)
            if self.held_bytes - len(self._body) > self._limit_bytes:
                return True
            if inflater.eof:
                if not inflater.unused_data and self._at == len(self._body):
                    self.payload = b"".join(self._parts)
                return True
            if not part and not inflater.unconsumed_tail and self._at == len(self._body):
                # Truncated: no input is left and nothing more comes out.
                return True
        return False


def start_compression(payload: bytes, *, zstd: bool) -> Compression | ZstdCompression:
    """A payload being compressed with zstd or zlib."""
    return ZstdCompression(payload, len(payload)) if zstd and len(payload) >= MIN_BYTES else Compression(payload)


def start_decompression(body: bytes, flags: int, limit_bytes: int) -> Decompression | ZstdDecompression:
    """A body with the flag COMPRESSED being inflated."""
    return (ZstdDecompression if flags & MessageFlag.ZSTD else Decompression)(body, limit_bytes)


def compress(payload: bytes, *, zstd: bool = False) -> bytes | None:
    """The compressed payload, or None if it is not shorter."""
    compression = start_compression(payload, zstd=zstd)
    while not compression.step():
        pass
    return compression.body


def decompress(body: bytes, limit_bytes: int) -> bytes | None:
    """The inverse of `compress`; None as in `Decompression.payload`."""
    decompression = Decompression(body, limit_bytes)
    while not decompression.step():
        pass
    return decompression.payload


@dataclass(frozen=True, slots=True)
class Uncompressed:
    """A message accepted but not yet compressed. `names` are its destinations (empty: broadcast); `store_keys` are the
    keys of their copies on disk."""

    message_id: MessageId
    channel: TopicChannel
    payload: bytes
    names: tuple[str, ...]
    accepted_at: float
    store_keys: tuple[int | None, ...] = ()
    zstd: bool = False


class CompressionQueue:
    """Messages waiting to be compressed: in the order accepted within a topic, the most urgent topic first."""

    __slots__ = ("_in_progress", "bytes", "topics")

    def __init__(self) -> None:
        self.topics: dict[str, deque[Uncompressed]] = {}
        """The messages of each topic that has any."""
        self._in_progress: dict[str, Compression | ZstdCompression] = {}
        self.bytes = 0

    def has_topic(self, topic: str) -> bool:
        """Whether a message of this topic waits, so that later ones must wait behind it."""
        return topic in self.topics

    def add(self, message: Uncompressed) -> None:
        self.topics.setdefault(message.channel.name, deque()).append(message)
        self.bytes += len(message.payload)

    def step(self) -> tuple[Uncompressed, bytes | None] | None:
        """Compress one step. Returns a message and its compressed body (None: send it uncompressed) when one is
        done."""
        name = min(self.topics, key=lambda topic: self.topics[topic][0].channel.topic.priority)
        compression = self._in_progress.get(name)
        if compression is None:
            first = self.topics[name][0]
            compression = self._in_progress[name] = start_compression(first.payload, zstd=first.zstd)
        if not compression.step():
            return None
        del self._in_progress[name]
        return self._pop(name), compression.body

    def drain(self) -> list[Uncompressed]:
        """Remove and return everything uncompressed, because the node closes."""
        self._in_progress.clear()
        return [self._pop(name) for name in list(self.topics) for _ in range(len(self.topics[name]))]

    def _pop(self, name: str) -> Uncompressed:
        waiting = self.topics[name]
        message = waiting.popleft()
        if not waiting:
            del self.topics[name]
        self.bytes -= len(message.payload)
        return message
