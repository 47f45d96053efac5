"""The items that this node holds: to the store and off it, to programs, and what is known of every log.

An item is announced and delivered once it is on disk. A node that becomes a reader of a log delivers what it only
carried so far, and forgets what it carried and dropped, so that it is requested again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from udp_mesh.core.events import Event, ExpiryReason, LogItemDropped, Receipt
from udp_mesh.core.logs.announcements import Announcements
from udp_mesh.core.logs.delivery import Deliveries
from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, decode_item
from udp_mesh.core.logs.knowledge import MAX_LOGS, LogState, as_set, forget_lowest, limit_ranges
from udp_mesh.core.logs.outcomes import Outcomes
from udp_mesh.core.logs.policy import Policy
from udp_mesh.core.logs.pulling import Pulling
from udp_mesh.core.logs.restore import Restorer
from udp_mesh.core.logs.retention import HeldItem, Shelf
from udp_mesh.core.logs.store import ItemUse, LogStore, RememberedLog
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.wire.errors import DecodeError


class Holdings:
    """`shelves` are also the policy's. `defer` is given what to call, with the time, once the store has answered;
    `wake` is called when there may be more to do."""

    def __init__(
        self,
        settings: Settings,
        store: LogStore,
        shelves: dict[str, Shelf],
        policy: Policy,
        *,
        announcements: Announcements,
        outcomes: Outcomes,
        pulling: Pulling,
        emit: Callable[[Event], None],
        defer: Callable[[Callable[[float], None]], None],
        wake: Callable[[], None],
        now: float,
    ) -> None:
        self.logs: dict[LogKey, LogState] = {}
        self.shelves = shelves
        self._store = store
        self._policy = policy
        self._announcements = announcements
        self._outcomes = outcomes
        self._pulling = pulling
        self._emit = emit
        self._defer = defer
        self._wake = wake
        self._deliveries = Deliveries(emit, store, defer, self._taken, confirms=settings.confirms)
        contents = store.load()
        self._restorer = Restorer(contents, now)
        self.key = SigningKey(contents.seed)
        self._read_topics: set[str] = set()

    def apply(self, topics: dict[str, Topic], now: float) -> list[str]:
        """Take over changed topics: those that are logs. Returns the ones that were none before, or not lately."""
        before, self._policy.topics = self._policy.topics, topics
        for name, topic in topics.items():
            assert topic.log is not None
            if name in self.shelves:
                self.shelves[name].log = topic.log
            else:
                self.shelves[name] = Shelf(topic.log, self.is_read, self.is_own)
        added = [name for name in topics if name not in before]
        self._restorer.restore(added, self.log, self.shelves)
        for item in (item for name in added for item, held in self.shelves[name].items.items() if held.waits):
            self._deliveries.enqueue(item)
        read, was_read = {name for name in topics if self._policy.is_reader(name)}, self._read_topics
        self._read_topics = read
        for state in self.logs.values():
            if state.key.topic in read - was_read:
                self._begin_reading(state, now)
        return added

    def _begin_reading(self, state: LogState, now: float) -> None:
        """Programs here are to get the items of this log from now on."""
        if len(state.carried):
            state.received = as_set(state.received.without(as_set(state.carried.without(state.held))))
            state.carried = RangeSet()
            held = self.shelves[state.key.topic].items
            carried = [item for item, entry in held.items() if item.log == state.key and entry.use is ItemUse.CARRIED]
            for item in carried:
                held[item].use = ItemUse.WAITING
                self._deliveries.enqueue(item)
            self._store.mark(carried, ItemUse.WAITING)
            self._store.drop((), (self._remembered(state),))
        if state.add_reader(self._policy.name, tuple(state.received.ranges())):
            self._announcements.note(state.key, now)

    # Questions

    def is_own(self, item: ItemId) -> bool:
        return self.is_own_log(item.log)

    def is_own_log(self, key: LogKey) -> bool:
        return key.source == self._policy.name and key.log_id == self.key.public

    def is_read(self, item: ItemId) -> bool:
        """Whether all named readers are known to have the item."""
        state, readers = self.logs.get(item.log), self._policy.readers(item.log.topic)
        return state is not None and bool(readers) and not state.readers_without(item.number, readers)

    def log(self, key: LogKey) -> LogState | None:
        """The state of a log. None if there are too many logs, or its topic is not a log."""
        state = self.logs.get(key)
        if state is None and key.topic in self._policy.topics and (len(self.logs) < MAX_LOGS or self.is_own_log(key)):
            state = self.logs[key] = LogState(key)
        return state

    # Items

    def put(self, item: LogItem, data: bytes, use: ItemUse) -> None:
        """Store an item of a known log."""
        state = self.logs[item.id.log]
        state.storing.add(item.id.number)
        self.shelves[item.id.log.topic].reserve(len(data))

        def done(stored: bool) -> None:
            self._defer(lambda now: self._stored(item, len(data), stored, use, now))

        self._store.put(item.id, data, use, done)

    def _stored(self, item: LogItem, size_bytes: int, stored: bool, use: ItemUse, now: float) -> None:
        key, number = item.id
        state = self.logs[key]
        state.storing.discard(number)
        self.shelves[key.topic].release(size_bytes)
        if not stored:
            if self.is_own(item.id):
                # The number stays used: the item may be on the disk after all.
                self._outcomes.drop(item.id)
                self._emit(LogItemDropped(key.topic, key.source, number, ExpiryReason.DISK))
            else:
                self._pulling.pause(now)
            return
        state.held.add(number)
        state.received.add(number)
        limit_ranges(state.received)
        self.shelves[key.topic].add(item.id, HeldItem(size_bytes, now, use))
        if use is ItemUse.CARRIED:
            state.carried.add(number)
            forget_lowest(state.carried)
        self._announcements.note(key, now)
        if self._policy.is_reader(key.topic):
            if use is ItemUse.CARRIED:
                # It became a reader while the disk was writing.
                self._begin_reading(state, now)
            elif state.add_reader(self._policy.name, ((number, number),)):
                state.deferred_until = None
        if use is ItemUse.WAITING:
            self._deliver(item)

    def lost(self, item: ItemId, now: float) -> None:
        """The disk does not return an item: others may still have it."""
        held, state = self.shelves[item.log.topic].remove(item), self.logs[item.log]
        if held is None:
            # Reported before, or dropped while it was read.
            return
        state.held.remove(item.number)
        if not self.is_own(item) and held.use is not ItemUse.TAKEN:
            # No program here has it yet.
            state.received.remove(item.number)
            state.carried.remove(item.number)
            self._store.drop((item,), (self._remembered(state),))
        self._emit(LogItemDropped(item.log.topic, item.log.source, item.number, ExpiryReason.DISK))
        self._announcements.note(item.log, now)

    def drop(self, item: ItemId, reason: ExpiryReason, now: float) -> None:
        """Remove an item, for good."""
        state, shelf = self.logs[item.log], self.shelves[item.log.topic]
        if not self.is_read(item):
            self._emit(LogItemDropped(item.log.topic, item.log.source, item.number, reason))
        shelf.remove(item)
        state.held.remove(item.number)
        self._outcomes.drop(item)
        self._store.drop((item,), (self._remembered(state),))
        self._announcements.note(item.log, now)

    def too_old(self, now: float) -> Sequence[ItemId]:
        """The items that are older than their logs keep."""
        return [item for topic in self._policy.topics for item in self.shelves[topic].too_old(now)]

    def _remembered(self, state: LogState) -> RememberedLog:
        return RememberedLog(state.key, tuple(state.received.ranges()), tuple(state.carried.ranges()))

    # Programs

    def confirm(self, receipt: Receipt) -> None:
        """A local program took an item, or keeps it on disk itself."""
        self._deliveries.confirm(receipt)

    def request_again(self, receipt: Receipt) -> None:
        """No local program took an item: deliver it again."""
        self._deliveries.returned(receipt)
        self._wake()

    def run(self) -> None:
        """Read what is to be delivered from the store."""
        self._deliveries.run(self._deliver_read)

    def _taken(self, item: ItemId) -> None:
        held = self.shelves[item.log.topic].items.get(item) if item.log.topic in self.shelves else None
        if held is not None and held.waits:
            held.use = ItemUse.TAKEN
            self._store.mark((item,), ItemUse.TAKEN)
            # There may be room for more now.
            self._wake()

    def _deliver(self, item: LogItem) -> None:
        topic = self._policy.topics.get(item.id.log.topic)
        if topic is not None:
            self._deliveries.deliver(item, topic.priority)

    def _deliver_read(self, item: ItemId, data: bytes | None, now: float) -> None:
        """Deliver an item that was read from the store."""
        self._wake()
        if item.log.topic not in self.shelves or item not in self.shelves[item.log.topic].items:
            return
        try:
            if data is None:
                raise DecodeError("the disk does not return it")
            self._deliver(decode_item(item.log.topic, data))
        except DecodeError:
            self.lost(item, now)
