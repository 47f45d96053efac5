"""Which readers and carriers have this node's own items: reported once each to the program that published them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from udp_mesh.core.events import Event, LogItemHeld, MessageDelivered, MessageId
from udp_mesh.core.logs.item import ItemId
from udp_mesh.core.logs.knowledge import LogState
from udp_mesh.core.ranges import RangeSet

MAX_OUTCOMES = 65_536
"""Own items whose readers are still awaited; of older ones no more events are sent."""


@dataclass(slots=True)
class _Published:
    message_id: MessageId
    accepted_at: float
    known_by: set[str] = field(default_factory=set)


class Outcomes:
    """Own items of this run, until all named readers have them."""

    def __init__(self, emit: Callable[[Event], None]) -> None:
        self._emit = emit
        self._published: dict[ItemId, _Published] = {}

    def add(self, item: ItemId, message_id: MessageId, now: float) -> None:
        self._published[item] = _Published(message_id, now)
        if len(self._published) > MAX_OUTCOMES:
            del self._published[next(iter(self._published))]

    def drop(self, item: ItemId) -> None:
        """The item was dropped here; other nodes may still deliver it."""
        self._published.pop(item, None)

    def report(
        self,
        state: LogState,
        before: Mapping[str, int],
        peer: str,
        carried: RangeSet,
        readers: Sequence[str],
        now: float,
    ) -> None:
        """Compare what readers have with the counts before, and report what is new. `carried` is what `peer` newly
        holds."""
        changed = [name for name, have in state.readers.items() if have.count != before.get(name, 0)]
        if not changed and not carried.count:
            return
        for item, published in list(self._published.items()):
            if item.log != state.key:
                continue
            for name in changed:
                if item.number in state.readers[name] and name != state.key.source and name not in published.known_by:
                    published.known_by.add(name)
                    latency_s = now - published.accepted_at
                    self._emit(MessageDelivered(published.message_id, name, item.log.topic, latency_s))
            if item.number in carried and peer not in published.known_by and readers and peer not in readers:
                published.known_by.add(peer)
                self._emit(LogItemHeld(published.message_id, peer, item.log.topic, item.number))
            if readers and all(name in published.known_by for name in readers if name != state.key.source):
                del self._published[item]
