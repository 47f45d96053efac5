"""Requested items out: a queue per peer -> the store -> messages, a few at a time.

Only a few items per peer are read ahead, so that memory holds little and more urgent topics are not delayed by reading.
An item that is already on its way to a peer is not sent twice, and one that is not needed any more is withdrawn, even
halfway.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from udp_mesh.core.events import MessageId, Rejected, RejectReason
from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.messages import item_topic
from udp_mesh.core.logs.store import LogStore
from udp_mesh.core.ranges import RangeSet

MAX_QUEUED = 256
"""Requested items waiting for one peer: it requests more once it has these."""
MAX_SENDING = 4
"""Items of one peer being read or sent."""
MAX_SENDING_BYTES = 4 << 20
"""Their size, beyond the first: bounds the memory held for a slow peer."""
RETRY_S = 0.5
"""Delay after the transport's queue for a peer was full."""

Send = Callable[[str, bytes, str | None, float], MessageId | Rejected]
"""(topic, payload, destination or None for all, now)."""

Withdraw = Callable[[str, MessageId, float], None]
"""(peer, message, now): the transport sends no more of it."""


def _never(_peer: str, _item: ItemId) -> bool:
    return False


@dataclass(slots=True, eq=False)
class _Service:
    """One peer's requests."""

    queue: dict[ItemId, None] = field(default_factory=dict)
    """What waits, in order: a request may name hundreds of items, and each is looked up."""
    sending: dict[ItemId, int] = field(default_factory=dict)
    """Items being read or sent, with their size once read."""
    retry_at: float = float("inf")
    """When to go on after a full queue (infinity: at once)."""


class Serving:
    """`lost` is called for an item that the store could not read."""

    def __init__(
        self, store: LogStore, send: Send, withdraw: Withdraw, defer: Callable[[Callable[[float], None]], None]
    ) -> None:
        self._store = store
        self._send = send
        self._withdraw = withdraw
        self._defer = defer
        self._peers: dict[str, _Service] = {}
        self._messages: dict[MessageId, tuple[str, ItemId]] = {}

    def request(self, peer: str, item: ItemId) -> bool:
        """A peer requests an item that is held here. Returns whether it may request more."""
        service = self._peers.setdefault(peer, _Service())
        if len(service.queue) >= MAX_QUEUED:
            return False
        if item not in service.sending and item not in service.queue:
            service.queue[item] = None
        return True

    def peer_offline(self, peer: str) -> None:
        """Forget what waits; what the transport already has stays there for a while."""
        service = self._peers.get(peer)
        if service is not None:
            service.queue.clear()

    def peer_has(self, peer: str, log: LogKey, held: RangeSet, now: float) -> None:
        """The peer has these items, perhaps from others."""
        self.withdraw(lambda to, item: to == peer and item.log == log and item.number in held, now)

    def withdraw(self, is_needless: Callable[[str, ItemId], bool], now: float) -> None:
        """Send none of these (peer, item) any more: what waits, what is being read, and what the transport has."""
        for peer, service in self._peers.items():
            if any(is_needless(peer, item) for item in service.queue):
                service.queue = {item: None for item in service.queue if not is_needless(peer, item)}
            for item in [item for item, size_bytes in service.sending.items() if not size_bytes]:
                if is_needless(peer, item):
                    del service.sending[item]
        for message, (peer, item) in list(self._messages.items()):
            if is_needless(peer, item):
                self._withdraw(peer, message, now)

    def run(
        self, now: float, lost: Callable[[ItemId, float], None], waits: Callable[[str, ItemId], bool] = _never
    ) -> None:
        """Read and send what may go now; what `waits` (peer, item) stays in the queue."""
        for peer, service in list(self._peers.items()):
            if now < service.retry_at < float("inf"):
                continue
            service.retry_at = float("inf")
            while (
                service.queue
                and service.retry_at == float("inf")
                and len(service.sending) < MAX_SENDING
                and sum(service.sending.values()) < MAX_SENDING_BYTES
                and not waits(peer, item := next(iter(service.queue)))
            ):
                del service.queue[item]
                service.sending[item] = 0
                self._read(peer, item, lost)
            if not service.queue and not service.sending:
                del self._peers[peer]

    def _read(self, peer: str, item: ItemId, lost: Callable[[ItemId, float], None]) -> None:
        def done(data: bytes | None) -> None:
            self._defer(lambda now: self._read_done(peer, item, data, lost, now))

        self._store.get(item, done)

    def _read_done(
        self, peer: str, item: ItemId, data: bytes | None, lost: Callable[[ItemId, float], None], now: float
    ) -> None:
        service = self._peers.get(peer)
        if service is None or item not in service.sending:
            return
        if data is None:
            del service.sending[item]
            lost(item, now)
            return
        outcome = self._send(item_topic(item.log.topic), data, peer, now)
        if isinstance(outcome, Rejected):
            del service.sending[item]
            service.retry_at = now + RETRY_S
            if outcome.reason is RejectReason.QUEUE_FULL:
                # It waits for the item, and does not request it again soon.
                service.queue = {item: None, **service.queue}
            return
        service.sending[item] = len(data)
        self._messages[outcome] = (peer, item)

    @property
    def next_at(self) -> float:
        """When `run` may continue after a full queue."""
        return min((service.retry_at for service in self._peers.values() if service.queue), default=float("inf"))

    def ended(self, message: MessageId) -> bool:
        """A message ended, whatever its outcome. Whether it was one of these."""
        entry = self._messages.pop(message, None)
        if entry is None:
            return False
        peer, item = entry
        service = self._peers.get(peer)
        if service is not None:
            service.sending.pop(item, None)
        return True
