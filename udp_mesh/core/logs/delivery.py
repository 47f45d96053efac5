"""Items to local programs, each with a receipt that says when a program has taken it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from functools import partial

from udp_mesh.core.events import Event, MessageReceived, Receipt
from udp_mesh.core.logs.item import ItemId, LogItem
from udp_mesh.core.logs.store import LogStore

LOG_RECEIPT = b"log"
"""`Receipt.boot_id` of items, which no boot has."""


class Deliveries:
    """`taken` is called for each item that a program took; without `confirms`, each delivered item counts as taken.
    `defer` is given what to call, with the time, once the store has answered."""

    def __init__(
        self,
        emit: Callable[[Event], None],
        store: LogStore,
        defer: Callable[[Callable[[float], None]], None],
        taken: Callable[[ItemId], None],
        *,
        confirms: bool,
    ) -> None:
        self._emit = emit
        self._store = store
        self._defer = defer
        self._taken = taken
        self._confirms = confirms
        self._next_receipt = 1
        self._receipts: dict[int, ItemId] = {}
        self._waiting: deque[ItemId] = deque()
        """Items to be read from the store and delivered."""
        self._pending: set[ItemId] = set()
        """These, and those with a receipt."""
        self._reading = False

    def deliver(self, item: LogItem, priority: int) -> None:
        """Pass an item to the driver, which passes it to programs."""
        receipt = None
        if self._confirms:
            receipt = Receipt(LOG_RECEIPT, self._next_receipt)
            self._receipts[self._next_receipt] = item.id
            self._pending.add(item.id)
            self._next_receipt += 1
        source, topic, number = item.id.log.source, item.id.log.topic, item.id.number
        self._emit(MessageReceived(source, topic, item.type_name, item.payload, priority, False, receipt, number))
        if not self._confirms:
            self._taken(item.id)

    def confirm(self, receipt: Receipt) -> None:
        """A program took the item, or the driver keeps it on disk itself."""
        item = self._receipts.pop(receipt.message_id, None)
        if item is not None:
            self._pending.discard(item)
            self._taken(item)

    def returned(self, receipt: Receipt) -> None:
        """No program took the item: it is to be read and delivered again."""
        item = self._receipts.pop(receipt.message_id, None)
        if item is not None:
            self._pending.discard(item)
            self.enqueue(item)

    def enqueue(self, item: ItemId) -> None:
        """Deliver an item on disk, at one of the next calls of `run`, unless a program may be reading it."""
        if item not in self._pending:
            self._pending.add(item)
            self._waiting.append(item)

    def run(self, deliver: Callable[[ItemId, bytes | None, float], None]) -> None:
        """Read the next item, whatever its size, once the one before was delivered."""
        if self._reading or not self._waiting:
            return
        self._reading = True
        item = self._waiting.popleft()

        def on_read(data: bytes | None, now: float) -> None:
            self._reading = False
            self._pending.discard(item)
            deliver(item, data, now)

        self._store.get(item, lambda data: self._defer(partial(on_read, data)))
