"""Carried datagrams that wait for one neighbor: strictly by priority, origins of one level in turn, bounded per origin.

`QueueBudget` counts over all neighbors what each origin, and each previous hop, has waiting here. Origins are what a
previous hop states; a member that invents them is bounded by its share as a previous hop.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from udp_mesh.wire.limits import PRIORITY_LEVELS
from udp_mesh.wire.relay import Carry

MAX_ORIGIN_BYTES = 256 << 10
"""Waiting here from one origin: 0.2 s at 10 Mbit/s. A flood through a relay fills this, and no other's queue."""
MAX_HOP_BYTES = 1 << 20
"""Waiting here from one previous hop: a member that invents origins."""
MAX_QUEUED_S = 2.0
"""Older datagrams are dropped: their sender has sent them again."""

CARRY_OVERHEAD_BYTES = 512
"""Memory of a waiting datagram beyond its bytes: without it, empty ones would wait without bound."""

_BEFORE_ALL = float("-inf")
"""At this time nothing is too old."""


class QueuedCarry(NamedTuple):
    carry: Carry
    previous: bytes
    """Boot id of the neighbor it came from; our own if it began here."""
    queued_at: float

    @property
    def size(self) -> int:
        return len(self.carry.datagram)

    @property
    def memory_bytes(self) -> int:
        return self.size + CARRY_OVERHEAD_BYTES


class QueueBudget:
    """Memory of what waits, by origin and by previous hop, over all queues of a node."""

    __slots__ = ("_origins", "_previous", "own")

    def __init__(self, own: bytes) -> None:
        self.own = own
        self._origins: dict[bytes, int] = {}
        self._previous: dict[bytes, int] = {}

    def has_room(self, item: QueuedCarry) -> bool:
        return self.origin_has_room(item) and self.hop_has_room(item)

    def origin_has_room(self, item: QueuedCarry) -> bool:
        return self._origins.get(item.carry.origin, 0) + item.memory_bytes <= MAX_ORIGIN_BYTES

    def hop_has_room(self, item: QueuedCarry) -> bool:
        return item.previous == self.own or self._previous.get(item.previous, 0) + item.memory_bytes <= MAX_HOP_BYTES

    def add(self, item: QueuedCarry) -> None:
        _change(self._origins, item.carry.origin, item.memory_bytes)
        _change(self._previous, item.previous, item.memory_bytes)

    def remove(self, item: QueuedCarry) -> None:
        _change(self._origins, item.carry.origin, -item.memory_bytes)
        _change(self._previous, item.previous, -item.memory_bytes)

    @property
    def memory_bytes(self) -> int:
        return sum(self._origins.values())


def _change(counts: dict[bytes, int], key: bytes, by: int) -> None:
    count = counts.get(key, 0) + by
    if count > 0:
        counts[key] = count
    else:
        counts.pop(key, None)


class HopQueue:
    """`dropped` counts what found no room or waited too long, `bytes` is what waits."""

    __slots__ = ("_budget", "_levels", "_waiting", "bytes", "dropped")

    def __init__(self, budget: QueueBudget) -> None:
        self._budget = budget
        self._levels: list[dict[bytes, deque[QueuedCarry]]] = [{} for _ in range(PRIORITY_LEVELS)]
        self._waiting = 0
        """Mask of the levels with a datagram."""
        self.dropped = 0
        self.bytes = 0

    def __bool__(self) -> bool:
        return bool(self._waiting)

    @property
    def first_level(self) -> int:
        """The most urgent level that waits."""
        return (self._waiting & -self._waiting).bit_length() - 1

    def push(self, item: QueuedCarry) -> None:
        """Add a datagram; without room, a less urgent one of its origin or previous hop goes, or this one."""
        while not self._budget.has_room(item):
            self.dropped += 1
            if not self._evict_for(item):
                return
        self._budget.add(item)
        self.bytes += item.size
        level = self._levels[item.carry.priority]
        level.setdefault(item.carry.origin, deque()).append(item)
        self._waiting |= 1 << item.carry.priority

    def _evict_for(self, item: QueuedCarry) -> bool:
        """Drop the newest less urgent datagram of the item's origin, or of its previous hop where that has no room.

        Urgent datagrams of one origin so pass those of the others behind the same relay. False if there is none.
        """
        origin_has_room = self._budget.origin_has_room(item)
        for level in range(PRIORITY_LEVELS - 1, item.carry.priority, -1):
            origins = self._levels[level]
            for origin in list(origins) if origin_has_room else (item.carry.origin,):
                waiting = origins.get(origin)
                if waiting and (not origin_has_room or waiting[-1].previous == item.previous):
                    self._removed(waiting.pop())
                    self._tidy(level, origin)
                    return True
        return False

    def pop(self, now: float) -> QueuedCarry | None:
        """The most urgent datagram that is not too old; the next one of its level comes from the next origin."""
        while self._waiting:
            priority = self.first_level
            level = self._levels[priority]
            origin = next(iter(level))
            item = level[origin].popleft()
            level[origin] = level.pop(origin)
            self._tidy(priority, origin)
            self._removed(item)
            if now - item.queued_at <= MAX_QUEUED_S:
                return item
            self.dropped += 1
        return None

    def drain(self) -> list[QueuedCarry]:
        """Everything that waits, whatever its age, in the order of `pop`."""
        items = []
        while (item := self.pop(_BEFORE_ALL)) is not None:
            items.append(item)
        return items

    def _removed(self, item: QueuedCarry) -> None:
        self._budget.remove(item)
        self.bytes -= item.size

    def _tidy(self, priority: int, origin: bytes) -> None:
        level = self._levels[priority]
        if not level[origin]:
            del level[origin]
        if not level:
            self._waiting &= ~(1 << priority)
