"""What is known of one log here: what this node holds, what it has had, and which readers have what.

`LogState` is one per log and node, `PeerView` what one online peer says it holds. Numbers are kept as ranges, because a
peer may claim any numbers; every collection is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.messages import HaveEntry, Holder, Ranges
from udp_mesh.core.ranges import RangeSet

MAX_LOGS = 4096
"""Logs that a node knows of: a key holder inventing sources."""
MAX_KEPT_RANGES = 4096
"""Ranges of one log of one node: numbers chosen with gaps."""
MAX_READERS = 64
"""Readers of one log that are remembered: a key holder inventing names."""


@dataclass(slots=True, eq=False)
class LogState:
    """One log. `held` can be given to others; `received` also contains what was dropped since."""

    key: LogKey
    held: RangeSet = field(default_factory=RangeSet)
    received: RangeSet = field(default_factory=RangeSet)
    storing: set[int] = field(default_factory=set)
    """Numbers being written to the disk."""
    readers: dict[str, RangeSet] = field(default_factory=dict)
    """By reader, including this node: what it has, or has had. Only grows."""
    deferred_until: float | None = None
    """Until when a node that only carries leaves the items to their readers, which seem to be in reach of them."""

    def remove_held(self, number: int) -> None:
        """The item was dropped."""
        gone = RangeSet()
        gone.add(number)
        kept = RangeSet()
        for first, last in self.held.without(gone):
            kept.add_range(first, last)
        self.held = kept

    def add_readers(self, holders: tuple[Holder, ...], allowed: tuple[str, ...]) -> bool:
        """Learn what readers have. Returns whether anything is new."""
        new = False
        for reader, ranges in holders:
            if (not allowed or reader in allowed) and self.add_reader(reader, ranges):
                new = True
        return new

    def add_reader(self, reader: str, ranges: Ranges) -> bool:
        """Learn what one reader has. Returns whether anything is new."""
        known = self.readers.get(reader)
        if known is None:
            if len(self.readers) >= MAX_READERS:
                return False
            known = self.readers[reader] = RangeSet()
        before = known.count
        for first, last in ranges:
            if len(known) < MAX_KEPT_RANGES:
                known.add_range(first, last)
        return known.count != before

    def readers_without(self, number: int, readers: tuple[str, ...]) -> list[str]:
        """The readers that are not known to have an item. With no named readers, those that are known at all."""
        names = readers or tuple(self.readers)
        return [name for name in names if name not in self.readers or number not in self.readers[name]]

    def read_by_all(self, readers: tuple[str, ...]) -> RangeSet:
        """The numbers that every named reader is known to have. Empty if no reader is named."""
        if not readers or any(name not in self.readers for name in readers):
            return RangeSet()
        common = self.readers[readers[0]]
        for name in readers[1:]:
            common = intersection(common, self.readers[name])
        return common

    def entry(self, readers: tuple[str, ...], *, reader_online: bool) -> HaveEntry:
        """What this node announces."""
        holders = tuple(
            Holder(name, tuple(have.ranges()))
            for name, have in sorted(self.readers.items())
            if not readers or name in readers
        )
        return HaveEntry(self.key, tuple(self.held.ranges()), holders, reader_online)


@dataclass(slots=True, eq=False)
class PeerView:
    """What one online peer holds."""

    held: dict[LogKey, RangeSet] = field(default_factory=dict)
    reader_online: set[LogKey] = field(default_factory=set)
    needs_all: bool = True
    """This node has not announced to it what it holds."""
    asked: bool = False
    """It was asked what it holds."""
    silent: bool = False
    """Nothing was heard from it for a while: it is online, but probably out of reach already."""

    def set_held(self, entry: HaveEntry) -> RangeSet:
        """Replace what it holds of one log; returns what is new."""
        before = self.held.get(entry.log)
        now = RangeSet()
        for first, last in entry.held:
            now.add_range(first, last)
        if before is None and len(self.held) >= MAX_LOGS:
            return RangeSet()
        self.held[entry.log] = now
        if entry.reader_online:
            self.reader_online.add(entry.log)
        else:
            self.reader_online.discard(entry.log)
        return now if before is None else as_set(now.without(before))


def as_set(ranges: Ranges | list[tuple[int, int]]) -> RangeSet:
    """Ranges as a set."""
    result = RangeSet()
    for first, last in ranges:
        result.add_range(first, last)
    return result


def intersection(one: RangeSet, other: RangeSet) -> RangeSet:
    """The numbers in both sets."""
    return as_set(one.without(as_set(one.without(other))))
