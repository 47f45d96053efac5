"""The items that this node holds of one topic, oldest first, and which of them to drop for newer ones.

In this order: what all readers have; what other nodes' items this node only carries; its own. An item that a local
program has not taken yet is never dropped for another one: then nothing more is requested.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from udp_mesh.core.logs.item import ItemId
from udp_mesh.core.logs.store import ItemUse
from udp_mesh.core.settings import Log

MAX_WRITING_BYTES = 16 << 20
"""Items of one topic that the disk has not stored yet, beyond which no more are requested: they are in memory until a
slow disk has them."""


@dataclass(slots=True)
class HeldItem:
    """One item on disk."""

    size_bytes: int
    stored_at: float
    use: ItemUse

    @property
    def waits(self) -> bool:
        """Whether a local program is to get it."""
        return self.use is ItemUse.WAITING


class Shelf:
    """The held items of one topic. `is_read` says whether all readers are known to have an item, `is_own` whether this
    node is its source."""

    def __init__(self, log: Log, is_read: Callable[[ItemId], bool], is_own: Callable[[ItemId], bool]) -> None:
        self.log = log
        self._is_read = is_read
        self._is_own = is_own
        self.items: dict[ItemId, HeldItem] = {}
        """In the order stored."""
        self.bytes = 0
        self.writing_items = 0
        self.writing_bytes = 0

    def add(self, item: ItemId, held: HeldItem) -> None:
        self.items[item] = held
        self.bytes += held.size_bytes

    def remove(self, item: ItemId) -> HeldItem | None:
        held = self.items.pop(item, None)
        if held is not None:
            self.bytes -= held.size_bytes
        return held

    def too_old(self, now: float) -> list[ItemId]:
        """The items older than the log keeps."""
        if self.log.max_age_s is None:
            return []
        limit = now - self.log.max_age_s
        old = []
        for item, held in self.items.items():
            if held.stored_at > limit:
                break
            old.append(item)
        return old

    def reserve(self, size_bytes: int) -> None:
        """An item of this size is being written."""
        self.writing_items += 1
        self.writing_bytes += size_bytes

    def release(self, size_bytes: int) -> None:
        """It was written, or refused."""
        self.writing_items -= 1
        self.writing_bytes -= size_bytes

    def make_room(self, size_bytes: int, *, own: bool, wanted: bool) -> list[ItemId] | None:
        """The items to drop so that one of this size fits, or None if it cannot. For an item that this node only
        carries (neither its `own` nor `wanted` by its programs), only what all readers have is dropped."""
        if size_bytes > self.log.max_bytes:
            return None
        dropped: list[ItemId] = []
        free_items, free_bytes = self._free()
        for item in self._candidates(own=own, wanted=wanted):
            if free_items >= 1 and free_bytes >= size_bytes:
                break
            dropped.append(item)
            free_items += 1
            free_bytes += self.items[item].size_bytes
        return dropped if free_items >= 1 and free_bytes >= size_bytes else None

    def room(self, limit: int, *, wanted: bool) -> int:
        """How many more items may be requested, at most `limit`; their sizes are not known yet."""
        if self.writing_bytes >= MAX_WRITING_BYTES:
            return 0
        free_items, free_bytes = self._free()
        if free_items >= limit and free_bytes > 0:
            return limit
        for item in self._candidates(own=False, wanted=wanted):
            if free_items >= limit and free_bytes > 0:
                break
            free_items += 1
            free_bytes += self.items[item].size_bytes
        return max(0, min(limit, free_items)) if free_bytes > 0 else 0

    def _free(self) -> tuple[int, int]:
        """(items, bytes) below the limits."""
        items = self.log.max_items - len(self.items) - self.writing_items
        return items, self.log.max_bytes - self.bytes - self.writing_bytes

    def _candidates(self, *, own: bool, wanted: bool) -> Iterator[ItemId]:
        """Lazily, since the first one is usually enough."""
        yield from (item for item, held in self.items.items() if not held.waits and self._is_read(item))
        if own or wanted:
            yield from self._unread(own=False)
        if own:
            yield from self._unread(own=True)

    def _unread(self, *, own: bool) -> Iterator[ItemId]:
        for item, held in self.items.items():
            if not held.waits and self._is_own(item) is own and not self._is_read(item):
                yield item
