"""The versions that a node holds for one sender's boot, so that the next ones may come as differences.

Each topic keeps the few that were received or referred to last; all of them together stay below the limit of the peer
and, with those of other peers, below that of the node. A dropped version costs one whole version later.
"""

from __future__ import annotations

from collections import OrderedDict

from udp_mesh.core.receiver.memory_limit import Account, MemoryBudget
from udp_mesh.core.versions.encoding import MIN_BASE_BYTES, Version
from udp_mesh.wire.version import NO_BASE, base_of

MAX_PER_TOPIC = 8
"""The sender refers to the newest version that it knows to have arrived: some more may be on their way meanwhile."""

_Key = tuple[str, str]
"""Topic and type."""


class HeldVersions:
    """Bounded by `limit_bytes` and the shared budget."""

    __slots__ = ("_account", "_versions", "limit_bytes")

    def __init__(self, limit_bytes: int, memory: MemoryBudget) -> None:
        self.limit_bytes = limit_bytes
        self._account = Account(memory)
        self._versions: OrderedDict[tuple[_Key, bytes], Version] = OrderedDict()
        """By topic and base name, the least recently used first."""

    @property
    def held_bytes(self) -> int:
        return self._account.bytes

    def find(self, topic: _Key, base: bytes) -> Version | None:
        """The version that a difference refers to."""
        version = self._versions.get((topic, base))
        if version is not None:
            self._versions.move_to_end((topic, base))
        return version

    def keep(self, topic: _Key, version: Version) -> None:
        """Keep a version just received, if there is room; older ones make room for it."""
        key = (topic, base_of(version.digest))
        size = version.kept_bytes
        self._drop(key)
        if key[1] == NO_BASE or len(version.payload) < MIN_BASE_BYTES or size > self.limit_bytes:
            return
        of_topic = [other for other in self._versions if other[0] == topic]
        for oldest in of_topic[: max(0, len(of_topic) + 1 - MAX_PER_TOPIC)]:
            self._drop(oldest)
        while self._versions and not self._fits(size):
            self._drop(next(iter(self._versions)))
        if self._fits(size):
            self._account.reserve(size)
            self._versions[key] = version

    def drop_topic(self, topic: _Key) -> None:
        """A version of the topic turned out to be damaged: trust none of them."""
        for key in [key for key in self._versions if key[0] == topic]:
            self._drop(key)

    def close(self) -> None:
        """Release what is held for a dropped peer."""
        self._versions.clear()
        self._account.close()

    def _fits(self, size: int) -> bool:
        return self._account.bytes + size <= self.limit_bytes and self._account.has_room(size)

    def _drop(self, key: tuple[_Key, bytes]) -> None:
        version = self._versions.pop(key, None)
        if version is not None:
            self._account.release(version.kept_bytes)
