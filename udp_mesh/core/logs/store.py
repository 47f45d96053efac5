"""Where items are kept: the interface that a driver implements on disk, and one in memory.

Calls do not wait for the disk: results come by callback, now or later, on the same thread. An item is announced and
delivered only after `put` has reported it as stored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.messages import Ranges


class StoredItem(NamedTuple):
    """One item found at the start."""

    id: ItemId
    size_bytes: int
    age_s: float
    """Time since it was stored."""
    taken: bool
    """Whether a local program took it, or none will."""


@dataclass(frozen=True, slots=True)
class LogContents:
    """What a store holds when a node starts. `seed` is the secret of this node's logs; it lives and dies with them, so
    that no number is used twice."""

    seed: bytes
    items: tuple[StoredItem, ...] = ()
    """In the order they were stored."""
    dropped: tuple[tuple[LogKey, Ranges], ...] = ()
    """Numbers that were stored once and must not be requested again."""


class LogStore(Protocol):
    """See the module's docstring."""

    def load(self) -> LogContents:
        """Everything kept. Called once, when a node starts."""
        ...

    def unix_ms(self) -> int:
        """The wall clock, in milliseconds since 1970: the creation time of own items."""
        ...

    def put(self, item: ItemId, data: bytes, *, taken: bool, done: Callable[[bool], None]) -> None:
        """Store an item; `done(True)` once it survives a power cut, `done(False)` if the disk refused it."""
        ...

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        """Read an item; `done(None)` if it cannot be read."""
        ...

    def take(self, item: ItemId) -> None:
        """Remember that a local program took the item."""
        ...

    def drop(self, items: Iterable[ItemId], dropped: Iterable[tuple[LogKey, Ranges]]) -> None:
        """Remove items; `dropped` replaces what is remembered of these logs."""
        ...


@dataclass(slots=True)
class MemoryLogStore:
    """A store that lasts as long as the object: for the simulator, tests, and programs without a disk."""

    seed: bytes
    clock: Callable[[], float] = lambda: 0.0
    items: dict[ItemId, tuple[bytes, float, bool]] = field(default_factory=dict)
    dropped: dict[LogKey, Ranges] = field(default_factory=dict)

    def load(self) -> LogContents:
        items = tuple(
            StoredItem(item, len(data), max(0.0, self.clock() - at), taken)
            for item, (data, at, taken) in self.items.items()
        )
        return LogContents(self.seed, items, tuple(self.dropped.items()))

    def unix_ms(self) -> int:
        return int(self.clock() * 1000)

    def put(self, item: ItemId, data: bytes, *, taken: bool, done: Callable[[bool], None]) -> None:
        self.items[item] = (data, self.clock(), taken)
        done(True)

    def get(self, item: ItemId, done: Callable[[bytes | None], None]) -> None:
        stored = self.items.get(item)
        done(None if stored is None else stored[0])

    def take(self, item: ItemId) -> None:
        stored = self.items.get(item)
        if stored is not None:
            self.items[item] = (stored[0], stored[1], True)

    def drop(self, items: Iterable[ItemId], dropped: Iterable[tuple[LogKey, Ranges]]) -> None:
        for item in items:
            self.items.pop(item, None)
        self.dropped.update(dropped)
