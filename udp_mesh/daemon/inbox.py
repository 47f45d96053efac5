"""Received messages whose senders keep them on disk: held on disk here too, until a local program takes them.

1. `add` writes a message to the disk. Once it is safe there, its sender is informed (`confirm`).
2. It goes to the subscribed programs at once, or to the first program that subscribes. A program that asked for
   receipts takes it by acknowledging the receipt; any other one takes it as soon as its socket has it completely.
3. What was taken is removed from the disk, or never written. After a restart, the rest goes to the next program that
   subscribes.

A message that the disk does not take is confirmed when a program took it; without one, its sender sends it again later.
An item of a log is on disk already, in the log: it is only noted here, and read again when a program subscribes.

A robot whose program starts hours late holds a hundred thousand messages: what happens for each message, or at each
visit of a client, must not go through all of them.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from udp_mesh.core.events import MessageReceived, Receipt
from udp_mesh.core.interfaces import StoredMessage
from udp_mesh.daemon.api import Client
from udp_mesh.daemon.outbox import DirectoryStore, Flusher

log = logging.getLogger(__name__)

RETRY_S = 5.0
"""Until a message that neither the disk nor a program took is requested from its sender again."""
CONFIRM_AT_END_S = 5.0

LoggedItem = tuple[str, str, int]
"""(source, topic, number) of an item of a log."""


@dataclass(slots=True)
class _Held:
    """A message that no program has taken yet."""

    topic: str
    receipt: Receipt | None
    """Set until the sender is informed that the message is safe."""
    on_disk: bool
    item: LoggedItem | None = None
    """Set for an item of a log."""
    reading: dict[Client, int | None] = field(default_factory=dict)
    """Programs that it was sent to: the position in the client's stream at which it is read, or None if the client is
    to acknowledge it."""


class Inbox:
    """`confirm` and `request_again` are those of the node."""

    def __init__(
        self,
        store: DirectoryStore,
        confirm: Callable[[Receipt], None],
        request_again: Callable[[Receipt], None],
    ) -> None:
        self._store = store
        self._flusher = Flusher(store)
        self._confirm = confirm
        self._request_again = request_again
        self._held: dict[int, _Held] = {}
        """By key, oldest first."""
        self._topics: Counter[str] = Counter()
        """How many messages of each topic are held."""
        self._unflushed: list[int] = []
        """Those added since the last `flush` began."""
        self._sent: dict[Client, set[int]] = {}
        """Those sent to each program."""
        self._unread: dict[Client, deque[tuple[int, int]]] = {}
        """Those that a program has not read yet: (position in its stream, key), in the order sent."""
        self._next_key = 0

    def __len__(self) -> int:
        return len(self._held)

    @property
    def needs_flush(self) -> bool:
        return self._store.needs_flush

    def load(self) -> None:
        """Hold what the last run left on disk."""
        for message in self._store.read_all():
            self._hold(message.key, _Held(message.topic, None, on_disk=True))
            self._next_key = message.key + 1

    def add(self, message: MessageReceived) -> int:
        """Write a message with a receipt to the disk, unless it is in a log. Returns its key."""
        key = self._next_key
        self._next_key += 1
        if message.number is not None:
            item = (message.source, message.topic, message.number)
            self._hold(key, _Held(message.topic, message.receipt, on_disk=False, item=item))
            return key
        stored = StoredMessage(key, message.source, message.topic, message.type_name, message.payload, None)
        self._hold(key, _Held(message.topic, message.receipt, on_disk=self._store.put(stored)))
        self._unflushed.append(key)
        return key

    def _hold(self, key: int, held: _Held) -> None:
        self._held[key] = held
        self._topics[held.topic] += 1

    def _release(self, key: int) -> _Held:
        held = self._held.pop(key)
        self._topics[held.topic] -= 1
        if not self._topics[held.topic]:
            del self._topics[held.topic]
        for client in held.reading:
            self._sent[client].discard(key)
        return held

    def on_distributed(self, key: int) -> None:
        """The message was sent to all programs subscribed now."""
        held = self._held.get(key)
        if held is not None and not held.on_disk and held.item is None and not held.reading:
            self._drop(key, held)
        self.take_read()

    async def flush(self) -> None:
        """Wait until everything added so far is on disk, then confirm it."""
        waiting, self._unflushed = self._unflushed, []
        await self._flusher.flush()
        for key in waiting:
            held = self._held.get(key)
            if held is None or held.receipt is None:
                continue
            if not self._confirm_on_disk(key, held, held.receipt) and not held.reading:
                self._drop(key, held)

    async def confirm_stored(self) -> None:
        """Before the end: wait until what is held is on disk, and confirm it; its sender would send it again. A second
        time for what came meanwhile. A disk that hangs does not hold up the goodbye."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(CONFIRM_AT_END_S):
                for _ in range(2):
                    keys = list(self._held)
                    await asyncio.wrap_future(self._store.flush())
                    for key in keys:
                        held = self._held.get(key)
                        if held is not None and held.receipt is not None and held.item is None:
                            self._confirm_on_disk(key, held, held.receipt)

    def _confirm_on_disk(self, key: int, held: _Held, receipt: Receipt) -> bool:
        """Confirm the message if it is on disk; whether it is."""
        held.on_disk = self._store.holds(key)
        if held.on_disk:
            self._confirm(receipt)
            held.receipt = None
        return held.on_disk

    def _drop(self, key: int, held: _Held) -> None:
        self._release(key)
        if held.receipt is not None:
            asyncio.get_running_loop().call_later(RETRY_S, self._request_again, held.receipt)

    # Programs

    def on_sent(self, key: int, client: Client, *, acknowledges: bool) -> None:
        """The message was written to a client's connection."""
        held = self._held.get(key)
        if held is None:
            return
        held.reading[client] = None if acknowledges else client.written_bytes
        self._sent.setdefault(client, set()).add(key)
        if not acknowledges:
            self._unread.setdefault(client, deque()).append((client.written_bytes, key))

    def waiting(self, matches: Callable[[str], bool]) -> list[int]:
        """The messages of these topics that no program is reading, oldest first."""
        topics = {topic for topic in self._topics if matches(topic)}
        return [key for key, held in self._held.items() if not held.reading and held.topic in topics]

    def is_waiting(self, key: int) -> bool:
        """Whether no program is reading the message."""
        held = self._held.get(key)
        return held is not None and not held.reading

    def topic(self, key: int) -> str | None:
        """The topic of a message that no program is reading; None if there is none any more."""
        held = self._held.get(key)
        return None if held is None or held.reading else held.topic

    def item(self, key: int) -> LoggedItem | None:
        """The item of a log that the message is; None if it is not one."""
        held = self._held.get(key)
        return None if held is None else held.item

    def request_item(self, key: int) -> None:
        """Have an item of a log read and delivered again, as a message of its own."""
        held = self._release(key)
        if held.receipt is not None:
            self._request_again(held.receipt)

    def read(self, key: int) -> StoredMessage | None:
        """The message from the disk. Blocks; None if it cannot be read."""
        return self._store.read(key)

    def acknowledge(self, client: Client, key: int) -> bool:
        """A program took the message. False if it was not sent to this client."""
        held = self._held.get(key)
        if held is None or client not in held.reading:
            return False
        self._take(key, held)
        return True

    def take_read(self) -> None:
        """Remove what programs have read."""
        for client, unread in list(self._unread.items()):
            read_bytes = client.read_bytes
            while unread and unread[0][0] <= read_bytes:
                _, key = unread.popleft()
                if (held := self._held.get(key)) is not None:
                    self._take_if_read(key, held)
            if not unread:
                del self._unread[client]

    def _take_if_read(self, key: int, held: _Held) -> None:
        """A message waits for its acknowledgment if one of its readers is to give it."""
        is_read = False
        for client, position in held.reading.items():
            if position is None:
                return
            is_read = is_read or client.read_bytes >= position
        if is_read:
            self._take(key, held)

    def _take(self, key: int, held: _Held) -> None:
        self._release(key)
        if held.receipt is not None:
            self._confirm(held.receipt)
        if held.item is None:
            self._store.remove(key)

    def client_gone(self, client: Client) -> None:
        """Messages that the client has not taken go to another one."""
        self.take_read()
        self._unread.pop(client, None)
        for key in sorted(self._sent.pop(client, ())):
            held = self._held[key]
            del held.reading[client]
            if held.reading:
                # others may have read it, and waited for this one's acknowledgment
                self._take_if_read(key, held)
            elif not held.on_disk and held.item is None:
                self._drop(key, held)

    def topics(self) -> Iterator[str]:
        return iter(self._topics)

    def close(self) -> None:
        """Waits until everything added is written."""
        self.take_read()
        self._store.close()
