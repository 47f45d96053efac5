"""Versions received from one boot of a peer: complete body -> base -> decoding -> hash checked -> kept and delivered.

A version whose base is not held, or whose result has the wrong hash, is refused with FORGOTTEN: the sender then sends
it again whole, and nothing of it was acknowledged.
"""

from __future__ import annotations

from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.settings import Limits
from udp_mesh.core.versions.conditions import VersionCounters
from udp_mesh.core.versions.decoding import VersionDecoding
from udp_mesh.core.versions.encoding import Version
from udp_mesh.core.versions.held import HeldVersions
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import MessageFlag, RefuseReason
from udp_mesh.wire.version import NO_BASE, decode_version

MAX_COUNTED_TOPICS = 1024
"""Topics counted by name; a peer may invent names without end."""

_Topic = tuple[str, str]
"""Name and type."""


class CounterTable:
    """The counters of a node by topic, of what it sends and of what it receives."""

    __slots__ = ("topics",)

    def __init__(self) -> None:
        self.topics: dict[str, VersionCounters] = {}

    def of(self, topic: str) -> VersionCounters:
        counters = self.topics.get(topic)
        if counters is None:
            if len(self.topics) >= MAX_COUNTED_TOPICS:
                return VersionCounters()
            counters = self.topics[topic] = VersionCounters()
        return counters


class ReceivedVersions:
    """The receiving half of a session, as far as versions are concerned."""

    __slots__ = ("_counters", "_limits", "held")

    def __init__(self, limits: Limits, memory: MemoryBudget, counters: CounterTable) -> None:
        self._limits = limits
        self._counters = counters
        self.held = HeldVersions(limits.version_bytes_per_peer, memory)

    def apply(self, limits: Limits) -> None:
        self._limits = limits
        self.held.limit_bytes = limits.version_bytes_per_peer

    def begin(self, topic: _Topic, body: bytes, flags: int) -> VersionDecoding | RefuseReason:
        """The decoding of a complete message with the flag VERSION, or why it is refused."""
        try:
            header, content = decode_version(body)
        except DecodeError:
            return RefuseReason.CORRUPT
        base = None
        if header.base != NO_BASE:
            base = self.held.find(topic, header.base)
            if base is None:
                self._counters.of(topic[0]).bases_missing += 1
                return RefuseReason.FORGOTTEN
        compressed = flags & MessageFlag.COMPRESSED != 0
        if compressed and not flags & MessageFlag.ZSTD:
            return RefuseReason.CORRUPT
        return VersionDecoding(header, content, base, self._limits.message_bytes, compressed=compressed)

    def finish(self, topic: _Topic, decoding: VersionDecoding, body_bytes: int) -> bytes | RefuseReason:
        """The version, if it was decoded to its hash; otherwise why it is refused."""
        counters = self._counters.of(topic[0])
        payload = decoding.payload
        if payload is None:
            if decoding.base is None:
                return RefuseReason.CORRUPT
            self.held.drop_topic(topic)
            counters.damaged += 1
            return RefuseReason.FORGOTTEN
        self.held.keep(topic, Version(decoding.header.digest, payload))
        counters.payload_bytes_received += len(payload)
        counters.body_bytes_received += body_bytes
        if decoding.base is None:
            counters.whole_received += 1
        else:
            counters.differences_received += 1
        return payload
