"""One bound over what all peers together make this node keep: a key holder invents names, each with its own limits.

The first half of it is anybody's. In the second half a peer may hold no more than an equal part, so that who came early
and took much leaves room for the others; past the whole no peer gets more.
"""

PARTIAL_BYTES = 600
"""Of an unfinished message besides its pieces: measured, objects and dictionary entries."""

TOPIC_BYTES = 400
"""Of a topic's number besides its two names."""

MAX_TOTAL_RANGES = 1 << 18
"""Ranges of finished message numbers of all peers: 20 MB. Honest peers have a few each."""

MIN_RANGES_PER_PEER = 16
"""Ranges that a peer keeps even then: as many as are reordered or given up at a time."""


class MemoryBudget:
    """Counts; who keeps something says so with `reserve` and `release`."""

    __slots__ = ("_half", "bytes", "holders", "limit", "ranges")

    def __init__(self, limit: int) -> None:
        self.bytes = 0
        self.ranges = 0
        self.holders = 0
        """Peers that hold something."""
        self.set_limit(limit)

    def set_limit(self, limit: int) -> None:
        self.limit = limit
        self._half = limit // 2

    def has_room(self, size: int, own: int) -> bool:
        """Whether a peer that holds `own` bytes may hold `size` more."""
        total = self.bytes + size
        if total <= self._half:
            return True
        return total <= self.limit and own + size <= self._half // max(1, self.holders)

    def too_many_ranges(self, own: int) -> bool:
        """Whether a peer with so many ranges must make do with fewer."""
        return self.ranges > MAX_TOTAL_RANGES and own > MIN_RANGES_PER_PEER


class Account:
    """What one peer holds of it."""

    __slots__ = ("_memory", "bytes", "ranges")

    def __init__(self, memory: MemoryBudget) -> None:
        self._memory = memory
        self.bytes = 0
        self.ranges = 0

    def has_room(self, size: int) -> bool:
        return self._memory.has_room(size, self.bytes)

    def reserve(self, size: int) -> None:
        if not self.bytes and size:
            self._memory.holders += 1
        self.bytes += size
        self._memory.bytes += size

    def release(self, size: int) -> None:
        self.bytes -= size
        self._memory.bytes -= size
        if not self.bytes and size:
            self._memory.holders -= 1

    def count_ranges(self, more: int) -> None:
        self.ranges += more
        self._memory.ranges += more

    def too_many_ranges(self, own: int) -> bool:
        return self._memory.too_many_ranges(own)

    def close(self) -> None:
        """The peer is forgotten, and all that is kept for it."""
        self.release(self.bytes)
        self.count_ranges(-self.ranges)
        # What is still being inflated ends on its own account.
        self._memory = MemoryBudget(1 << 62)
