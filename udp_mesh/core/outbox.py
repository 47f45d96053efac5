"""Messages held for offline peers according to their topic's outbox: none, the last one, or all within a limit.

1. `persist` writes a message to disk when it is accepted, if its topic requires that. It stays there until its outcome
   is known, so a crash in between sends it again.
2. `hold` queues it while its peer is offline, in the order accepted, and returns the older ones dropped for it.
3. `release` returns the most urgent and oldest messages in batches: a long absence accumulates a hundred thousand.
4. `forget` removes it from disk once its outcome is known.

A partly sent message keeps its number, so that a peer that received all of it before the link was lost does not deliver
it twice.
"""

from collections import deque
from dataclasses import dataclass, field
from heapq import heapify, heappop, heappush

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.interfaces import Store, StoredMessage
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage
from udp_mesh.core.sender.send_memory import SendMemory
from udp_mesh.core.settings import Outbox


@dataclass(slots=True, eq=False)
class HeldMessage:
    """One message held for one peer; `store_key` is set if it is on disk."""

    accepted: AcceptedMessage
    store_key: int | None
    started: OutgoingMessage | None = None
    """The partly sent message, if the peer may have some of it."""
    epoch: int = 0
    """`Sender.epoch` in which it was started."""
    dropped: bool = False
    """Expired or replaced; it stays in its queue until the next access."""

    @property
    def size(self) -> int:
        return len(self.accepted.payload)


@dataclass(slots=True)
class _TopicQueue:
    """The messages of one topic held for one peer, in the order accepted."""

    held: deque[HeldMessage] = field(default_factory=deque)
    messages: int = 0
    bytes: int = 0

    def front(self) -> HeldMessage:
        """The oldest message. Call only if there is one."""
        while self.held[0].dropped:
            self.held.popleft()
        return self.held[0]

    def put(self, new: HeldMessage) -> None:
        """Insert in order: usually the newest; one returned by the sender is older than all that came meanwhile."""
        later: list[HeldMessage] = []
        if self.messages and new.accepted.message_id < self.front().accepted.message_id:
            self.held.appendleft(new)
        else:
            while self.held and self.held[-1].accepted.message_id > new.accepted.message_id:
                later.append(self.held.pop())
            self.held.append(new)
            self.held.extend(reversed(later))
        self.messages += 1
        self.bytes += new.size

    def drop(self, held: HeldMessage) -> None:
        held.dropped = True
        self.messages -= 1
        self.bytes -= held.size
        if len(self.held) > 64 + 2 * self.messages:
            self.held = deque(waiting for waiting in self.held if not waiting.dropped)


class Outboxes:
    """By peer name and topic."""

    __slots__ = ("_deadlines", "_held", "_memory", "_messages", "_next_key", "_serial", "_store", "bytes")

    def __init__(self, store: Store | None, memory: SendMemory) -> None:
        self._memory = memory
        self._held: dict[str, dict[str, _TopicQueue]] = {}
        self._deadlines: list[tuple[float, int, str, HeldMessage]] = []
        self._messages = 0
        self._serial = 0
        self._store = store
        self._next_key = 0
        self.bytes = 0

    def load(self) -> list[StoredMessage]:
        """The messages that the last run left on disk, oldest first; the node adds each one with `hold` and its key."""
        if self._store is None:
            return []
        stored = self._store.load()
        self._next_key = max((message.key for message in stored), default=-1) + 1
        return stored

    def persist(self, peer: str, accepted: AcceptedMessage, now: float) -> int | None:
        """Write a message to disk if its topic requires that. Returns its key, or None if it is in memory only."""
        topic = accepted.channel.topic
        if self._store is None or not topic.keeps_on_disk:
            return None
        key = self._next_key
        self._next_key += 1
        remaining = None if accepted.deadline is None else max(0.0, accepted.deadline - now)
        type_name = accepted.channel.type_name
        stored = StoredMessage(key, peer, topic.name, type_name, accepted.payload, remaining)
        return key if self._store.put(stored) else None

    def on_disk(self, store_key: int | None) -> bool:
        """Whether the message will survive a restart."""
        return store_key is not None and self._store is not None and self._store.holds(store_key)

    def hold(self, peer: str, new: HeldMessage, now: float) -> list[tuple[HeldMessage, ExpiryReason]]:
        """Hold a message. Returns those dropped for it (perhaps this one)."""
        accepted = new.accepted
        topic = accepted.channel.topic
        if new.size > topic.outbox_bytes:
            self.forget(new.store_key)
            return [(new, ExpiryReason.OUTBOX_FULL)]
        queue = self._held.setdefault(peer, {}).setdefault(topic.name, _TopicQueue())
        queue.put(new)
        self.bytes += new.size
        self._messages += 1
        self._memory.add(peer, accepted)
        dropped: list[tuple[HeldMessage, ExpiryReason]] = []
        last = topic.outbox is Outbox.LAST
        while queue.messages > 1 if last else queue.bytes > topic.outbox_bytes:
            oldest = queue.front()
            self._drop(peer, queue, oldest)
            dropped.append((oldest, ExpiryReason.SUPERSEDED if last else ExpiryReason.OUTBOX_FULL))
        if not new.dropped:
            if not self.on_disk(new.store_key):
                new.store_key = self.persist(peer, accepted, now)
            self._note_deadline(peer, new)
        return dropped

    def release(self, peer: str, limit: int) -> list[HeldMessage]:
        """Release up to `limit` messages for a peer that is online, most urgent first, then oldest. They stay on
        disk."""
        queues = self._held.get(peer, {})
        released: list[HeldMessage] = []
        by_urgency: dict[int, list[_TopicQueue]] = {}
        for queue in queues.values():
            if queue.messages:
                by_urgency.setdefault(queue.front().accepted.channel.topic.priority, []).append(queue)
        for _, level in sorted(by_urgency.items()):
            heads = [(queue.front().accepted.message_id, place) for place, queue in enumerate(level)]
            heads.sort()
            while heads and len(released) < limit:
                _, place = heappop(heads)
                queue = level[place]
                held = queue.front()
                queue.held.popleft()
                self._remove(peer, queue, held)
                released.append(held)
                if queue.messages:
                    heappush(heads, (queue.front().accepted.message_id, place))
        if not self.holds(peer):
            self._held.pop(peer, None)
        return released

    def holds(self, peer: str, topic: str | None = None) -> bool:
        """Whether a message (of this topic) is held for a peer."""
        queues = self._held.get(peer)
        if not queues:
            return False
        if topic is None:
            return any(queue.messages for queue in queues.values())
        return topic in queues and queues[topic].messages > 0

    def forget(self, store_key: int | None) -> None:
        """Remove a message from disk: its outcome is known."""
        if store_key is not None and self._store is not None:
            self._store.remove(store_key)

    def expire(self, now: float) -> list[tuple[str, HeldMessage]]:
        """Remove everything past its deadline; returns (peer, message)."""
        late: list[tuple[str, HeldMessage]] = []
        while self._deadlines and (self._deadlines[0][0] <= now or self._deadlines[0][3].dropped):
            _, _, peer, held = heappop(self._deadlines)
            if not held.dropped:
                self._drop(peer, self._held[peer][held.accepted.channel.topic.name], held)
                late.append((peer, held))
        return late

    def drop_all(self) -> list[tuple[str, HeldMessage]]:
        """Close: returns the messages that are in memory only and now lost; what is on disk stays there."""
        everything = [
            (peer, held)
            for peer, queues in self._held.items()
            for queue in queues.values()
            for held in queue.held
            if not held.dropped
        ]
        for peer, held in everything:
            self._memory.remove(peer, held.accepted)
        self._held.clear()
        self._deadlines.clear()
        self.bytes = self._messages = 0
        return [(peer, held) for peer, held in everything if not self.on_disk(held.store_key)]

    def peers(self) -> list[str]:
        return [peer for peer in self._held if self.holds(peer)]

    def count(self, peer: str) -> tuple[int, int]:
        """(messages, bytes) held for a peer."""
        queues = self._held.get(peer, {}).values()
        return sum(queue.messages for queue in queues), sum(queue.bytes for queue in queues)

    def _drop(self, peer: str, queue: _TopicQueue, held: HeldMessage) -> None:
        self._remove(peer, queue, held)
        self.forget(held.store_key)

    def _remove(self, peer: str, queue: _TopicQueue, held: HeldMessage) -> None:
        queue.drop(held)
        self.bytes -= held.size
        self._messages -= 1
        self._memory.remove(peer, held.accepted)

    def _note_deadline(self, peer: str, held: HeldMessage) -> None:
        deadline = held.accepted.deadline
        if deadline is None:
            return
        self._serial += 1
        heappush(self._deadlines, (deadline, self._serial, peer, held))
        if len(self._deadlines) > 64 + 2 * self._messages:
            # Free messages that were replaced or sent long before their deadline.
            self._deadlines = [entry for entry in self._deadlines if not entry[3].dropped]
            heapify(self._deadlines)
