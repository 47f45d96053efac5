"""One memory budget for unfinished messages of all peers: a key holder can invent names, each with its own limits.

The first half is available to any peer. In the second half each peer may hold at most an equal share, so that early
heavy users leave room for others. Beyond the total no peer gets more.
"""

PARTIAL_BYTES = 600
"""Overhead of an unfinished message without its fragments: measured, objects and dictionary entries."""

TOPIC_BYTES = 400
"""Overhead of a topic without its two names."""

MAX_TOTAL_RANGES = 1 << 18
"""Ranges of finished message numbers of all peers: 20 MB. Honest peers have a few each."""

MIN_RANGES_PER_PEER = 16
"""Ranges that a peer always keeps: as many as are reordered or abandoned at a time."""


class MemoryBudget:
    """Only counts; holders call `reserve` and `release`."""

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
        """Whether a peer with so many ranges must drop some."""
        return self.ranges > MAX_TOTAL_RANGES and own > MIN_RANGES_PER_PEER


class Account:
    """The share of one peer."""

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
        """Release everything held for a dropped peer."""
        self.release(self.bytes)
        self.count_ranges(-self.ranges)
        # Messages still being inflated finish without a shared limit.
        self._memory = MemoryBudget(1 << 62)
