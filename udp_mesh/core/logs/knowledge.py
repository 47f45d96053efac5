"""Knowledge of one log: the items this node holds, those it has had, and those each reader has.

`LogState` is one per log and node, `PeerView` what one online peer says it holds. Numbers are kept as ranges, because a
peer may claim any numbers; every collection is bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.messages import MAX_ORDER, Have, HaveEntry, Holder, Ranges
from udp_mesh.core.ranges import RangeSet

WEAK_PATIENCE_S = 60.0
"""A link that stays weak for this long does not become better soon: it is used."""
MAX_LOGS = 4096
"""Logs that a node knows of: a key holder inventing sources."""
MAX_KEPT_RANGES = 4096
"""Ranges of one log of one node: numbers chosen with gaps."""
MAX_LOST_NUMBERS = 1 << 20
"""Own numbers beyond the newest one known that others may have: items that the disk lost after all."""
MAX_READERS = 64
"""Readers of one log that are remembered: a key holder inventing names."""


@dataclass(slots=True, eq=False)
class LogState:
    """One log. `held` can be given to others; `received` also contains what was dropped since."""

    key: LogKey
    held: RangeSet = field(default_factory=RangeSet)
    received: RangeSet = field(default_factory=RangeSet)
    carried: RangeSet = field(default_factory=RangeSet)
    """Those in `received` that no program here was to get, because this node was no reader then."""
    storing: set[int] = field(default_factory=set)
    """Numbers being written to the disk."""
    readers: dict[str, RangeSet] = field(default_factory=dict)
    """By reader, including this node: what it has, or has had. Only grows."""
    used: int = 0
    """If this node is the source: the highest number it gave an item, though the disk may not have it."""
    deferred_until: float | None = None
    """Until when a node that only carries leaves the items to their readers, which seem to be in reach of them."""

    def note_used(self, entry: HaveEntry) -> None:
        """If this node is the source: numbers that others have are used, even if its disk lost them. Claims far beyond
        its own numbers are not believed, so that a key holder cannot use all of them up."""
        newest = max(self.used, max((last for _, last in self.received.ranges()[-1:]), default=0))
        for ranges in (entry.held, *(holder.ranges for holder in entry.readers)):
            if ranges and ranges[-1][1] <= newest + MAX_LOST_NUMBERS:
                self.used = max(self.used, ranges[-1][1])

    def add_readers(self, holders: tuple[Holder, ...], allowed: tuple[str, ...]) -> dict[str, Ranges]:
        """Learn what readers have. Returns what is new, by reader."""
        new = {
            reader: self.add_reader(reader, ranges) for reader, ranges in holders if not allowed or reader in allowed
        }
        return {reader: ranges for reader, ranges in new.items() if ranges}

    def add_reader(self, reader: str, ranges: Ranges) -> Ranges:
        """Learn what one reader has. Returns what is new. The time it takes depends on the ranges given, hardly on
        those known."""
        known = self.readers.get(reader)
        if known is None:
            if len(self.readers) >= MAX_READERS:
                return ()
            known = self.readers[reader] = RangeSet()
        new: list[tuple[int, int]] = []
        for first, last in ranges:
            if gaps := known.gaps(first, last):
                known.add_range(first, last)
                new += gaps
                limit_ranges(known)
        return tuple(new)

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
        """This node's announcement."""
        holders = tuple(
            Holder(name, tuple(have.ranges()))
            for name, have in sorted(self.readers.items())
            if not readers or name in readers
        )
        return HaveEntry(self.key, tuple(self.held.ranges()), holders, reader_online)


@dataclass(slots=True, eq=False)
class PeerView:
    """The items that one online peer holds."""

    held: dict[LogKey, RangeSet] = field(default_factory=dict)
    reader_online: set[LogKey] = field(default_factory=set)
    needs_all: bool = True
    """This node has not announced to it what it holds."""
    announced_at: float = float("-inf")
    """When all that this node holds was announced to it last."""
    asked: bool = False
    """It was asked what it holds."""
    weak_since: float | None = None
    """Since when much of what it sends to all is lost; None while it is not."""
    silent: bool = False
    """Nothing was heard from it for a while: it is online, but probably out of reach already."""
    heard_at: int = 0
    """The newest `Have` from it, counted on beyond `MAX_ORDER`."""
    cleared_at: int = 0
    """The newest complete one."""
    listed_at: dict[LogKey, int] = field(default_factory=dict)
    """The newest one that listed each log."""

    def is_weak(self, now: float) -> bool:
        """Whether the link to it is weak, and may become better soon."""
        return self.weak_since is not None and now - self.weak_since < WEAK_PATIENCE_S

    def place(self, message: Have) -> int:
        """Where a message is in the order of those from this peer. One that does not count comes after all others. If
        it is complete, what only earlier ones listed is forgotten."""
        ahead = (message.order - self.heard_at) % MAX_ORDER if message.order else 1
        if ahead > MAX_ORDER // 2 and self.heard_at:
            ahead -= MAX_ORDER
        place = self.heard_at + ahead
        self.heard_at = max(self.heard_at, place)
        if message.complete:
            self._clear_before(place)
        return place

    def _clear_before(self, place: int) -> None:
        if place < self.cleared_at:
            return
        self.cleared_at = place
        for log in [log for log in self.held if self.listed_at.get(log, 0) < place]:
            self.held.pop(log)
            self.listed_at.pop(log, None)
            self.reader_online.discard(log)

    def set_held(self, entry: HaveEntry, place: int) -> RangeSet | None:
        """Replace what it holds of one log; returns what is new, or None if a newer message said otherwise."""
        before = self.held.get(entry.log)
        if place < max(self.cleared_at, self.listed_at.get(entry.log, 0)):
            return None
        now = as_set(entry.held)
        if before is None and len(self.held) >= MAX_LOGS:
            return RangeSet()
        self.held[entry.log] = now
        self.listed_at[entry.log] = place
        if entry.reader_online:
            self.reader_online.add(entry.log)
        else:
            self.reader_online.discard(entry.log)
        return now if before is None else as_set(now.without(before))


def limit_ranges(numbers: RangeSet) -> None:
    """Bound the memory: beyond the limit the lowest gaps count as had, so that a log continues. No node fills them any
    more: thousands of later items came meanwhile."""
    while len(numbers) > MAX_KEPT_RANGES:
        numbers.fill_lowest_gap()


def forget_lowest(numbers: RangeSet) -> None:
    """Bound the memory: beyond the limit the lowest ranges are forgotten."""
    while len(numbers) > MAX_KEPT_RANGES:
        first, last = numbers.ranges()[0]
        numbers.remove_range(first, last)


def as_set(ranges: Ranges | list[tuple[int, int]]) -> RangeSet:
    """Ranges as a set."""
    result = RangeSet()
    for first, last in ranges:
        result.add_range(first, last)
    return result


def intersection(a: RangeSet, b: RangeSet) -> RangeSet:
    """The numbers in both sets."""
    return as_set(a.without(as_set(a.without(b))))
