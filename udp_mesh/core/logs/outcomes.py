"""Report which readers and carriers have this node's own items: once each, to the program that published them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

from udp_mesh.core.events import Event, LogItemHeld, MessageDelivered, MessageId
from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.messages import Ranges

MAX_OUTCOMES = 65_536
"""Own items of one log whose readers are still awaited; of older ones no more events are sent."""


@dataclass(slots=True)
class _Published:
    message_id: MessageId
    accepted_at: float
    read_by: set[str] = field(default_factory=set)
    carried_by: set[str] = field(default_factory=set)


class Outcomes:
    """Own items of this run, until all named readers have them."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit
        self._published: dict[LogKey, dict[int, _Published]] = {}
        """By log and number, in ascending order."""

    def add(self, item: ItemId, message_id: MessageId, now: float) -> None:
        published = self._published.setdefault(item.log, {})
        published[item.number] = _Published(message_id, now)
        if len(published) > MAX_OUTCOMES:
            del published[next(iter(published))]

    def drop(self, item: ItemId) -> None:
        """The item was dropped here; other nodes may still deliver it."""
        self._published.get(item.log, {}).pop(item.number, None)

    def report(
        self,
        log: LogKey,
        read: Mapping[str, Ranges],
        peer: str,
        carried: Ranges,
        readers: Sequence[str],
        now: float,
    ) -> None:
        """Report what is new: `read` is what readers, and `carried` what `peer`, have as of now. Other ranges are not
        looked at, so that the time it takes does not depend on how many items still wait."""
        published = self._published.get(log, {})
        for name, ranges in read.items():
            if name == log.source:
                continue
            for number in _numbers(published, ranges):
                entry = published[number]
                if name not in entry.read_by:
                    entry.read_by.add(name)
                    self._emit(MessageDelivered(entry.message_id, name, log.topic, now - entry.accepted_at))
        if readers and peer not in readers:
            for number in _numbers(published, carried):
                entry = published[number]
                if peer not in entry.carried_by:
                    entry.carried_by.add(peer)
                    self._emit(LogItemHeld(entry.message_id, peer, log.topic, number))
        awaited = {name for name in readers if name != log.source}
        if readers:
            for ranges in read.values():
                for number in list(_numbers(published, ranges)):
                    if awaited <= published[number].read_by:
                        del published[number]


def _numbers(published: dict[int, _Published], ranges: Ranges) -> Iterator[int]:
    """The published numbers in these ranges."""
    if not published:
        return
    lowest, highest = next(iter(published)), next(reversed(published))
    for first, last in ranges:
        yield from (number for number in range(max(first, lowest), min(last, highest) + 1) if number in published)
