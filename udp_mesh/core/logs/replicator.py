"""The shared logs of one node: items in from programs and peers, items out to readers and peers that lack them.

It has no socket and no disk: messages leave by `send`, which is the node's own, items go to a `LogStore`, and `run`
does what is due. The package's docstring lists the steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

from udp_mesh.core.events import Event, ExpiryReason, LogItemDropped, MessageId, Receipt, Rejected, RejectReason
from udp_mesh.core.logs.announcements import Announcements
from udp_mesh.core.logs.conditions import LogConditions, conditions_of
from udp_mesh.core.logs.delivery import Deliveries
from udp_mesh.core.logs.item import FIRST_NUMBER, MAX_NUMBER, ItemId, LogItem, LogKey, decode_item, encode_item
from udp_mesh.core.logs.knowledge import MAX_LOGS, LogState, PeerView, as_set, intersection, limit_ranges
from udp_mesh.core.logs.messages import CONTROL_TOPIC, Have, HaveEntry, ItemRequest, decode_control, encode_control
from udp_mesh.core.logs.outcomes import Outcomes
from udp_mesh.core.logs.policy import Policy
from udp_mesh.core.logs.pulling import Pulling
from udp_mesh.core.logs.restore import Restorer
from udp_mesh.core.logs.retention import HeldItem, Shelf
from udp_mesh.core.logs.serving import Send, Serving
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.settings import Settings
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.wire.errors import DecodeError

MAINTENANCE_S = 1.0
"""Interval at which too old items are dropped."""


class Replicator:
    """`emit` takes events for the node's driver; `next_message_id` numbers own items as other messages are."""

    def __init__(
        self,
        settings: Settings,
        store: LogStore,
        *,
        send: Send,
        emit: Callable[[Event], None],
        next_message_id: Callable[[], MessageId],
        now: float,
    ) -> None:
        self.logs: dict[LogKey, LogState] = {}
        self.peers: dict[str, PeerView] = {}
        self.shelves: dict[str, Shelf] = {}
        self.policy = Policy(settings.name, self.shelves, self.peers)
        self._store = store
        self._send = send
        self._emit = emit
        self._next_message_id = next_message_id
        self._completed: deque[Callable[[float], None]] = deque()
        self._serving = Serving(store, send, self._completed.append)
        self._pulling = Pulling()
        self._announcements = Announcements(send, self._entry, now)
        self._outcomes = Outcomes(emit)
        self._deliveries = Deliveries(emit, store, self._completed.append, self._taken, confirms=settings.confirms)
        self._maintain_at = now + MAINTENANCE_S
        self._run_soon = False
        self.rejected_items = 0
        """Items that were malformed, not signed by their source, or of no log here."""
        self.duplicate_items = 0
        self.dropped_items = 0
        """Items dropped before all their readers were known to have them."""
        contents = store.load()
        self._restorer = Restorer(contents, now)
        self._key = SigningKey(contents.seed)
        self.apply(settings)

    def apply(self, settings: Settings) -> None:
        """Take over changed topics. Items of a topic that is no log any more stay on disk."""
        before = self.policy.topics
        self.policy.topics = {topic.name: topic for topic in settings.topics if topic.log is not None}
        for name, topic in self.policy.topics.items():
            assert topic.log is not None
            if name in self.shelves:
                self.shelves[name].log = topic.log
            else:
                self.shelves[name] = Shelf(topic.log, self._is_read, self._is_own)
        added = [name for name in self.policy.topics if name not in before]
        if added:
            self._begin(added)
        self._run_soon = True

    def _begin(self, topics: Sequence[str]) -> None:
        """These topics are logs from now on, perhaps again."""
        self._restorer.restore(topics, self._log, self.shelves)
        for state in self.logs.values():
            if state.key.topic in topics and self.policy.is_reader(state.key.topic):
                state.add_reader(self.policy.name, tuple(state.received.ranges()))
        for item in (item for name in topics for item, held in self.shelves[name].items.items() if not held.taken):
            self._deliveries.again(item)
        for view in self.peers.values():
            # What they hold of these topics was ignored so far.
            view.needs_all, view.asked = True, False

    # Questions

    @property
    def has_work(self) -> bool:
        """Whether `run` has something to do now."""
        return bool(self._completed) or self._run_soon

    @property
    def next_at(self) -> float:
        """When `run` is due next."""
        return min(self._announcements.next_at, self._maintain_at, self._pulling.next_at, self._serving.next_at)

    def conditions(self) -> tuple[LogConditions, ...]:
        """A snapshot for the status page and the metrics."""
        readers = {topic: self.policy.readers(topic) for topic in self.policy.topics}
        declared = (state for state in self.logs.values() if state.key.topic in self.policy.topics)
        return conditions_of(declared, self.peers, self.shelves, readers)

    def _is_own(self, item: ItemId) -> bool:
        return self._is_own_log(item.log)

    def _is_own_log(self, key: LogKey) -> bool:
        return key.source == self.policy.name and key.log_id == self._key.public

    def _is_read(self, item: ItemId) -> bool:
        state, readers = self.logs.get(item.log), self.policy.readers(item.log.topic)
        return state is not None and bool(readers) and not state.readers_without(item.number, readers)

    def _log(self, key: LogKey) -> LogState | None:
        state = self.logs.get(key)
        if state is None and key.topic in self.policy.topics and (len(self.logs) < MAX_LOGS or self._is_own_log(key)):
            state = self.logs[key] = LogState(key)
        return state

    # Programs

    def append(self, topic: str, payload: bytes, type_name: str, now: float) -> MessageId | Rejected:
        """Publish the next item of this node's log. It is announced once it is on disk."""
        key = LogKey(topic, self.policy.name, self._key.public)
        state = self._log(key)
        assert state is not None, "a node's own log does not count toward the limit"
        newest = max((last for _, last in state.received.ranges()[-1:]), default=FIRST_NUMBER - 1)
        number = max(newest, state.used) + 1
        item = LogItem(ItemId(key, number), self._store.unix_ms(), type_name, payload)
        data = encode_item(self._key, item)
        dropped = self.shelves[topic].make_room(len(data), own=True, wanted=False)
        log = self.shelves[topic].log
        if dropped is None or number > MAX_NUMBER:
            return Rejected(
                RejectReason.LOG_FULL,
                f"an item of {len(data)} bytes does not fit into {log.max_items} items and {log.max_bytes} bytes",
            )
        for old in dropped:
            self._drop(old, ExpiryReason.LOG_FULL, now)
        state.used = number
        message_id = self._next_message_id()
        self._outcomes.add(item.id, message_id, now)
        self._put(item, data, taken=True)
        return message_id

    def confirm(self, receipt: Receipt) -> None:
        """A local program took an item, or keeps it on disk itself."""
        self._deliveries.confirm(receipt)

    def request_again(self, receipt: Receipt) -> None:
        """No local program took an item: deliver it again."""
        self._deliveries.returned(receipt)
        self._run_soon = True

    def _taken(self, item: ItemId) -> None:
        held = self.shelves[item.log.topic].items.get(item) if item.log.topic in self.shelves else None
        if held is not None and not held.taken:
            held.taken = True
            self._store.take(item)
            # There may be room for more now.
            self._run_soon = True

    def _deliver(self, item: LogItem) -> None:
        topic = self.policy.topics.get(item.id.log.topic)
        if topic is not None:
            self._deliveries.deliver(item, topic.priority)

    def _deliver_read(self, item: ItemId, data: bytes | None, now: float) -> None:
        """Deliver an item that was read from the store."""
        self._run_soon = True
        if item.log.topic not in self.shelves or item not in self.shelves[item.log.topic].items:
            return
        try:
            if data is None:
                raise DecodeError("the disk does not return it")
            self._deliver(decode_item(item.log.topic, data))
        except DecodeError:
            self._lost(item, now)

    # Peers

    def peer_online(self, peer: str, now: float) -> None:
        """A peer with logs is online, or began a new run."""
        self._pulling.requests.forget(peer)
        self.peers[peer] = PeerView()
        for key in self.logs:
            if peer in self.policy.readers(key.topic):
                # Others leave the items to this reader for a while.
                self._announcements.note(key, now)
        self._run_soon = True

    def peer_offline(self, peer: str) -> None:
        """The peer is out of reach: request its items from others."""
        if self.peers.pop(peer, None) is not None:
            self._pulling.requests.forget(peer)
            self._serving.peer_offline(peer)
            self._run_soon = True

    def peer_silent(self, peer: str, silent: bool) -> None:
        """Nothing was heard from the peer for a while, or it is heard again: request from whom is in reach."""
        view = self.peers[peer]
        if view.silent is not silent:
            view.silent = silent
            self._pulling.requests.forget(peer)
            self._run_soon = True

    def on_control(self, peer: str, payload: bytes, now: float) -> None:
        """A `Have` or `ItemRequest` of a peer. Malformed ones are counted."""
        view = self.peers.get(peer)
        try:
            message = decode_control(payload)
        except DecodeError:
            self.rejected_items += 1
            return
        match message:
            case Have() if view is not None:
                self._on_have(peer, view, message, now)
            case ItemRequest():
                # Even from a peer that is not online here yet: it hears us.
                for key, ranges in message.entries:
                    self._on_request(peer, view, key, ranges)
            case _:
                return
        self._run_soon = True

    def _on_have(self, peer: str, view: PeerView, message: Have, now: float) -> None:
        view.silent = False
        place = view.place(message)
        if message.asks:
            # What was requested before may not have reached it.
            view.needs_all = True
            self._pulling.requests.forget(peer)
        # Each log once, whatever a key holder lists: looking at one may take long.
        for entry in {entry.log: entry for entry in message.entries}.values():
            state = self._log(entry.log)
            if state is None:
                continue
            new, readers = view.set_held(entry, place), self.policy.readers(entry.log.topic)
            read = state.add_readers(entry.readers, readers)
            if read:
                self._announcements.note(entry.log, now, heard=True)
                state.deferred_until = None
            if self._is_own_log(entry.log):
                state.note_used(entry)
                self._outcomes.report(entry.log, read, peer, tuple(new.ranges()) if new else (), readers, now)
            if new is not None:
                self._pulling.requests.keep_only(peer, entry.log, as_set(entry.held))
            self._serving.peer_has(peer, entry.log, as_set([*entry.held, *dict(entry.readers).get(peer, ())]))

    def _on_request(self, peer: str, view: PeerView | None, key: LogKey, ranges: tuple[tuple[int, int], ...]) -> None:
        state = self.logs.get(key)
        if state is None:
            return
        wanted = as_set(ranges)
        available = intersection(state.held, wanted)
        numbers = (number for first, last in available.ranges() for number in range(first, last + 1))
        if not all(self._serving.request(peer, ItemId(key, number)) for number in numbers):
            return
        if view is not None and available.count < wanted.count:
            # Something was dropped meanwhile: list what is left.
            view.needs_all = True

    def on_item(self, peer: str, topic: str, payload: bytes, now: float) -> None:
        """An item from a peer: verify, store, announce and deliver it, unless it was not asked for."""
        settings = self.policy.topics.get(topic)
        try:
            if settings is None:
                raise DecodeError(f"topic {topic}: expected a log")
            item = decode_item(topic, payload)
        except DecodeError:
            self.rejected_items += 1
            return
        self._pulling.requests.received(item.id, now)
        self._run_soon = True
        state = self._log(item.id.log)
        wanted = self.policy.is_reader(topic)
        if state is None or not (wanted or self.policy.copies(topic)):
            self.rejected_items += 1
            return
        number = item.id.number
        if number in state.received or number in state.storing:
            self.duplicate_items += 1
            return
        dropped = self.shelves[topic].make_room(len(payload), own=False, wanted=wanted)
        if dropped is None:
            self._pulling.refuse(item.id, now)
            return
        for old in dropped:
            self._drop(old, ExpiryReason.LOG_FULL, now)
        self._put(item, bytes(payload), taken=not wanted)

    def on_outcome(self, message: MessageId) -> bool:
        """A message of the transport ended. Whether it carried an item or an announcement of these logs."""
        ended = self._serving.ended(message)
        self._run_soon = self._run_soon or ended
        return ended

    # Items

    def _put(self, item: LogItem, data: bytes, *, taken: bool) -> None:
        state = self.logs[item.id.log]
        state.storing.add(item.id.number)
        self.shelves[item.id.log.topic].reserve(len(data))

        def done(stored: bool) -> None:
            self._completed.append(lambda now: self._stored(item, len(data), stored, taken, now))

        self._store.put(item.id, data, taken=taken, done=done)

    def _stored(self, item: LogItem, size_bytes: int, stored: bool, taken: bool, now: float) -> None:
        key, number = item.id
        state = self.logs[key]
        state.storing.discard(number)
        self.shelves[key.topic].release(size_bytes)
        if not stored:
            if self._is_own(item.id):
                # The number stays used: the item may be on the disk after all.
                self._outcomes.drop(item.id)
                self._emit(LogItemDropped(key.topic, key.source, number, ExpiryReason.DISK))
            else:
                self._pulling.pause(now)
            return
        state.held.add(number)
        state.received.add(number)
        limit_ranges(state.received)
        self.shelves[key.topic].add(item.id, HeldItem(size_bytes, now, taken))
        if self.policy.is_reader(key.topic) and state.add_reader(self.policy.name, ((number, number),)):
            state.deferred_until = None
        self._announcements.note(key, now)
        if not taken:
            self._deliver(item)

    def _lost(self, item: ItemId, now: float) -> None:
        """The disk does not return an item: others may still have it."""
        held, state = self.shelves[item.log.topic].remove(item), self.logs[item.log]
        if held is None:
            # Reported before, or dropped while it was read.
            return
        state.held.remove(item.number)
        if not self._is_own(item) and not (held.taken and self.policy.is_reader(item.log.topic)):
            # No program here has it yet.
            state.received.remove(item.number)
        self._emit(LogItemDropped(item.log.topic, item.log.source, item.number, ExpiryReason.DISK))
        self._announcements.note(item.log, now)

    def _drop(self, item: ItemId, reason: ExpiryReason, now: float) -> None:
        state, shelf = self.logs[item.log], self.shelves[item.log.topic]
        if not self._is_read(item):
            self.dropped_items += 1
            self._emit(LogItemDropped(item.log.topic, item.log.source, item.number, reason))
        shelf.remove(item)
        state.held.remove(item.number)
        self._outcomes.drop(item)
        self._store.drop((item,), ((item.log, tuple(state.received.ranges())),))
        self._announcements.note(item.log, now)

    def _entry(self, key: LogKey, peer: str) -> HaveEntry | None:
        """What is announced of a log to a peer."""
        if key.topic not in self.policy.topics:
            return None
        online = self.policy.reader_online(key.topic, excluding=peer)
        return self.logs[key].entry(self.policy.readers(key.topic), reader_online=online)

    # What is due

    def run(self, now: float) -> None:
        """Do what is due: results of the disk, requested items, requests, announcements, retention."""
        if not self.has_work and now < self.next_at:
            return
        self._run_soon = False
        while self._completed:
            self._completed.popleft()(now)
        if now >= self._maintain_at:
            self._maintain_at = now + MAINTENANCE_S
            for topic in self.policy.topics:
                for item in self.shelves[topic].too_old(now):
                    self._drop(item, ExpiryReason.TOO_OLD, now)
        self._deliveries.run(self._deliver_read)
        self._announcements.run(self.logs, self.peers, now)
        for peer, message in self._pulling.plan(self.logs, self.peers, self.policy, now):
            if isinstance(self._send(CONTROL_TOPIC, encode_control(message), peer, now), Rejected):
                self._pulling.not_sent(peer, now)
        self._serving.run(now, self._lost)
        while self._completed:
            self._completed.popleft()(now)
