"""Items to local programs, each with a receipt that says when a program has taken it."""

from __future__ import annotations

from collections.abc import Callable

from udp_mesh.core.events import Event, MessageReceived, Receipt
from udp_mesh.core.logs.item import ItemId, LogItem

LOG_RECEIPT = b"log"
"""`Receipt.boot_id` of items, which no boot has."""


class Deliveries:
    """`taken` is called for each item that a program took. Without `confirms`, a delivered item counts as taken."""

    def __init__(self, emit: Callable[[Event], None], taken: Callable[[ItemId], None], *, confirms: bool) -> None:
        self._emit = emit
        self._taken = taken
        self._confirms = confirms
        self._next_receipt = 1
        self._receipts: dict[int, LogItem] = {}

    def deliver(self, item: LogItem, priority: int) -> None:
        """Pass an item to the driver, which passes it to programs."""
        receipt = None
        if self._confirms:
            receipt = Receipt(LOG_RECEIPT, self._next_receipt)
            self._receipts[self._next_receipt] = item
            self._next_receipt += 1
        source, topic, number = item.id.log.source, item.id.log.topic, item.id.number
        self._emit(MessageReceived(source, topic, item.type_name, item.payload, priority, False, receipt, number))
        if not self._confirms:
            self._taken(item.id)

    def confirm(self, receipt: Receipt) -> None:
        """A program took the item, or the driver keeps it on disk itself."""
        item = self._receipts.pop(receipt.message_id, None)
        if item is not None:
            self._taken(item.id)

    def returned(self, receipt: Receipt) -> LogItem | None:
        """The driver could not keep the item: it is to be delivered again."""
        return self._receipts.pop(receipt.message_id, None)
