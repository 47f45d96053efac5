"""Where items are kept: the interface that a driver implements on disk, and one in memory.

Calls do not wait for the disk: results come by callback, now or later, on the same thread. An item is announced and
delivered only after `put` has reported it as stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple, Protocol

from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.messages import Ranges


class ItemUse(IntEnum):
    """How the programs of this node use an item. The values are on disk."""

    WAITING = 0
    """One of them is to get it."""
    TAKEN = 1
    """One of them took or published it."""
    CARRIED = 2
    """None was to get it: the node only carries it."""


class RememberedLog(NamedTuple):
    """The record of a log whose items were dropped."""

    log: LogKey
    received: Ranges
    """Numbers that were stored once and must not be requested again."""
    carried: Ranges = ()
    """Those of them that no program here was to get."""


class StoredItem(NamedTuple):
    """One item found at the start."""

    id: ItemId
    size_bytes: int
    age_s: float
    """Time since it was stored."""
    use: ItemUse


@dataclass(frozen=True, slots=True)
class LogContents:
    """The contents of a store when a node starts. `seed` is the secret of this node's logs; it lives and dies with
    them, so that no number is used twice."""

    seed: bytes
    items: tuple[StoredItem, ...] = ()
    """In the order they were stored."""
    remembered: tuple[RememberedLog, ...] = ()


class LogStore(Protocol):
    """See the module's docstring."""

    def load(self) -> LogContents:
        """Everything kept. Called once, when a node starts."""
        ...

    def unix_ms(self) -> int:
        """The wall clock, in milliseconds since 1970: the creation time of own items."""
        ...

    def put(self, item: ItemId, data: bytes, use: ItemUse, done: Callable[[bool], None]) -> None:
        """Store an item; `done(True)` once it survives a power cut, `done(False)` if the disk refused it."""
        ...

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        """Read an item; `done(None)` if it cannot be read."""
        ...

    def mark(self, items: Iterable[ItemId], use: ItemUse) -> None:
        """Change the use of items."""
        ...

    def drop(self, items: Iterable[ItemId], remembered: Iterable[RememberedLog]) -> None:
        """Remove items; `remembered` replaces what was remembered of these logs."""
        ...


@dataclass(slots=True)
class MemoryLogStore:
    """A store that lasts as long as the object: for the simulator, tests, and programs without a disk."""

    seed: bytes
    clock: Callable[[], float] = lambda: 0.0
    items: dict[ItemId, tuple[bytes, float, ItemUse]] = field(default_factory=dict)
    remembered: dict[LogKey, RememberedLog] = field(default_factory=dict)

    def load(self) -> LogContents:
        items = tuple(
            StoredItem(item, len(data), max(0.0, self.clock() - at), use)
            for item, (data, at, use) in self.items.items()
        )
        return LogContents(self.seed, items, tuple(self.remembered.values()))

    def unix_ms(self) -> int:
        return int(self.clock() * 1000)

    def put(self, item: ItemId, data: bytes, use: ItemUse, done: Callable[[bool], None]) -> None:
        self.items[item] = (data, self.clock(), use)
        done(True)

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        stored = self.items.get(item)
        done(None if stored is None else stored[0])

    def mark(self, items: Iterable[ItemId], use: ItemUse) -> None:
        for item in items:
            if (stored := self.items.get(item)) is not None:
                self.items[item] = (stored[0], stored[1], use)

    def drop(self, items: Iterable[ItemId], remembered: Iterable[RememberedLog]) -> None:
        for item in items:
            self.items.pop(item, None)
        self.remembered.update({entry.log: entry for entry in remembered})
