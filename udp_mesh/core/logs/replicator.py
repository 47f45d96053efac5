"""The shared logs of one node: items in from programs and peers, items out to readers and peers that lack them.

It has no socket and no disk: messages leave by `send`, which is the node's own, items go to a `LogStore`, and `run`
does what is due. The package's docstring lists the steps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from udp_mesh.core.events import Event, ExpiryReason, MessageId, Rejected, RejectReason
from udp_mesh.core.logs.announcements import Announcements
from udp_mesh.core.logs.conditions import LogConditions, conditions_of
from udp_mesh.core.logs.holdings import Holdings
from udp_mesh.core.logs.item import FIRST_NUMBER, MAX_NUMBER, ItemId, LogItem, LogKey, decode_item, encode_item
from udp_mesh.core.logs.knowledge import LogState, PeerView, as_set, intersection
from udp_mesh.core.logs.messages import CONTROL_TOPIC, Have, HaveEntry, ItemRequest, decode_control, encode_control
from udp_mesh.core.logs.outcomes import Outcomes
from udp_mesh.core.logs.policy import Policy
from udp_mesh.core.logs.pulling import Pulling
from udp_mesh.core.logs.retention import Shelf
from udp_mesh.core.logs.serving import Send, Serving, Withdraw
from udp_mesh.core.logs.store import ItemUse, LogStore
from udp_mesh.core.settings import Settings
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
        withdraw: Withdraw,
        emit: Callable[[Event], None],
        next_message_id: Callable[[], MessageId],
        now: float,
    ) -> None:
        shelves: dict[str, Shelf] = {}
        self.peers: dict[str, PeerView] = {}
        self.policy = Policy(settings.name, shelves, self.peers)
        self._store = store
        self._send = send
        self._next_message_id = next_message_id
        self._completed: deque[Callable[[float], None]] = deque()
        self._serving = Serving(store, send, withdraw, self._completed.append)
        self._pulling = Pulling()
        self._announcements = Announcements(send, self._entry, self._is_urgent, now)
        self._outcomes = Outcomes(emit)
        self.holdings = Holdings(
            settings,
            store,
            shelves,
            self.policy,
            announcements=self._announcements,
            outcomes=self._outcomes,
            pulling=self._pulling,
            emit=emit,
            defer=self._completed.append,
            wake=self._wake,
            now=now,
        )
        self._maintain_at = now + MAINTENANCE_S
        self._run_soon = False
        self.rejected_items = 0
        """Items that were malformed, not signed by their source, or of no log here."""
        self.apply(settings, now)

    def apply(self, settings: Settings, now: float) -> None:
        """Take over changed topics. Items of a topic that is no log any more stay on disk."""
        topics = {topic.name: topic for topic in settings.topics if topic.log is not None}
        if self.holdings.apply(topics, now):
            for view in self.peers.values():
                # What they hold of the added topics was ignored so far.
                view.needs_all, view.asked = True, False
        self._wake()

    def _wake(self) -> None:
        self._run_soon = True

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
        declared = (state for state in self.holdings.logs.values() if state.key.topic in self.policy.topics)
        return conditions_of(declared, self.peers, self.holdings.shelves, readers)

    # Programs

    def append(self, topic: str, payload: bytes, type_name: str, now: float) -> MessageId | Rejected:
        """Publish the next item of this node's log. It is announced once it is on disk."""
        key = LogKey(topic, self.policy.name, self.holdings.key.public)
        state = self.holdings.log(key)
        assert state is not None, "a node's own log does not count toward the limit"
        newest = max((last for _, last in state.received.ranges()[-1:]), default=FIRST_NUMBER - 1)
        number = max(newest, state.used) + 1
        item = LogItem(ItemId(key, number), self._store.unix_ms(), type_name, payload)
        data = encode_item(self.holdings.key, item)
        shelf = self.holdings.shelves[topic]
        dropped = shelf.make_room(len(data), own=True, wanted=False)
        if dropped is None or number > MAX_NUMBER:
            limits = f"{shelf.log.max_items} items and {shelf.log.max_bytes} bytes"
            return Rejected(RejectReason.LOG_FULL, f"an item of {len(data)} bytes does not fit into {limits}")
        for old in dropped:
            self._drop(old, ExpiryReason.LOG_FULL, now)
        state.used = number
        message_id = self._next_message_id()
        self._outcomes.add(item.id, message_id, now)
        self.holdings.put(item, data, ItemUse.TAKEN)
        return message_id

    # Peers

    def peer_online(self, peer: str, now: float) -> None:
        """A peer with logs is online, or began a new run."""
        self._pulling.requests.forget(peer)
        self.peers[peer] = PeerView()
        for key in self.holdings.logs:
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

    def peer_weak(self, peer: str, weak: bool, now: float) -> None:
        """Much of what the peer sends is lost, or no longer: what this node only carries is requested from others."""
        view = self.peers[peer]
        if (view.weak_since is not None) is not weak:
            view.weak_since = now if weak else None
            # What waits there is requested from others, or again.
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
            state = self.holdings.log(entry.log)
            if state is None:
                continue
            new, readers = view.set_held(entry, place), self.policy.readers(entry.log.topic)
            read = state.add_readers(entry.readers, readers)
            if read:
                self._announcements.note(entry.log, now, heard=True)
                state.deferred_until = None
            if self.holdings.is_own_log(entry.log):
                state.note_used(entry)
                self._outcomes.report(entry.log, read, peer, tuple(new.ranges()) if new else (), readers, now)
            if new is not None:
                self._pulling.requests.keep_only(peer, entry.log, as_set(entry.held))
            self._serving.peer_has(peer, entry.log, as_set([*entry.held, *dict(entry.readers).get(peer, ())]), now)
            if read and readers:
                self._leave_read(state, readers, now)

    def _leave_read(self, state: LogState, readers: tuple[str, ...], now: float) -> None:
        """Withdraw items that all readers have now: they need no carriers."""
        everything = state.read_by_all(readers)
        if not self.policy.is_reader(state.key.topic):
            self._pulling.requests.remove(state.key, everything)
        self._serving.withdraw(
            lambda to, item: to not in readers and item.log == state.key and item.number in everything, now
        )

    def _on_request(self, peer: str, view: PeerView | None, key: LogKey, ranges: tuple[tuple[int, int], ...]) -> None:
        state = self.holdings.logs.get(key)
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
        state = self.holdings.log(item.id.log)
        wanted = self.policy.is_reader(topic)
        if state is None or not (wanted or self.policy.copies(topic)):
            self.rejected_items += 1
            return
        number = item.id.number
        if number in state.received or number in state.storing:
            return
        dropped = self.holdings.shelves[topic].make_room(len(payload), own=False, wanted=wanted)
        if dropped is None:
            self._pulling.refuse(item.id, now)
            return
        for old in dropped:
            self._drop(old, ExpiryReason.LOG_FULL, now)
        self.holdings.put(item, bytes(payload), ItemUse.WAITING if wanted else ItemUse.CARRIED)

    def on_outcome(self, message: MessageId) -> bool:
        """A message of the transport ended. Whether it carried an item or an announcement of these logs."""
        ended = self._serving.ended(message) or self._announcements.ended(message)
        self._run_soon = self._run_soon or ended
        return ended

    # Items

    def _drop(self, item: ItemId, reason: ExpiryReason, now: float) -> None:
        if reason is ExpiryReason.TOO_OLD:
            self._serving.withdraw(lambda _, sent: sent == item, now)
        self.holdings.drop(item, reason, now)

    def _entry(self, key: LogKey, peer: str) -> HaveEntry | None:
        """The announcement of a log to a peer."""
        if key.topic not in self.policy.topics:
            return None
        online = self.policy.reader_online(key.topic, excluding=peer)
        return self.holdings.logs[key].entry(self.policy.readers(key.topic), reader_online=online)

    def _is_urgent(self, key: LogKey, peer: str) -> bool:
        """Whether a peer can act at once on what is new of a log."""
        return self.holdings.is_own_log(key) or peer == key.source or peer in self.policy.readers(key.topic)

    def _waits(self, peer: str, item: ItemId, now: float) -> bool:
        """Whether an item for a carrier waits for a better link."""
        view, readers = self.peers.get(peer), self.policy.readers(item.log.topic)
        return view is not None and bool(readers) and peer not in readers and view.is_weak(now)

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
            for item in self.holdings.too_old(now):
                self._drop(item, ExpiryReason.TOO_OLD, now)
        self.holdings.run()
        self._announcements.run(self.holdings.logs, self.peers, now)
        for peer, message in self._pulling.plan(self.holdings.logs, self.peers, self.policy, now):
            if isinstance(self._send(CONTROL_TOPIC, encode_control(message), peer, now), Rejected):
                self._pulling.not_sent(peer, now)
        self._serving.run(now, self.holdings.lost, lambda peer, item: self._waits(peer, item, now))
        while self._completed:
            self._completed.popleft()(now)
