"""Messages held for peers that are offline, as their topic's outbox says: none, the last, or all within a bound.

A message on disk stays there until its outcome is known, not only until it is sent: a crash in between sends it again.
One that had begun to leave keeps its number, so that a peer which had all of it before the cut does not take it twice.
"""

from dataclasses import dataclass

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.message import Accepted, Outgoing
from udp_mesh.core.seams import Store, StoredMessage
from udp_mesh.core.settings import Outbox


@dataclass(slots=True)
class Held:
    """One message held for one peer; `store_key` where it is on disk."""

    accepted: Accepted
    store_key: int | None
    begun: Outgoing | None = None
    """What has left of it, where the peer may have it."""
    epoch: int = 0
    """`Outbound.epoch` in which it began."""


class Outboxes:
    """By peer name, oldest first."""

    __slots__ = ("_held", "_next_key", "_store", "bytes")

    def __init__(self, store: Store | None) -> None:
        self._held: dict[str, list[Held]] = {}
        self._store = store
        self._next_key = 0
        self.bytes = 0

    def load(self) -> list[StoredMessage]:
        """What the last run left on disk, oldest first; the node takes each on anew with `hold` and its key."""
        if self._store is None:
            return []
        stored = self._store.load()
        self._next_key = max((message.key for message in stored), default=-1) + 1
        return stored

    def hold(self, peer: str, new: Held, now: float) -> list[tuple[Held, ExpiryReason]]:
        """Keep a message; returns those that had to go for it (perhaps this one)."""
        accepted = new.accepted
        topic = accepted.channel.topic
        kept = self._held.setdefault(peer, [])
        same = [held for held in kept if held.accepted.channel.topic.name == topic.name]
        gone: list[tuple[Held, ExpiryReason]] = []
        if topic.outbox is Outbox.LAST:
            gone = [(held, ExpiryReason.SUPERSEDED) for held in same]
        else:
            room = topic.outbox_bytes - len(accepted.payload)
            used = sum(len(held.accepted.payload) for held in same)
            for held in same:
                if used <= room:
                    break
                used -= len(held.accepted.payload)
                gone.append((held, ExpiryReason.OUTBOX_FULL))
        for held, _ in gone:
            self._remove(kept, held)
        if len(accepted.payload) > topic.outbox_bytes:
            gone.append((new, ExpiryReason.OUTBOX_FULL))
            self.settle(new.store_key)
            return gone
        if new.store_key is None and topic.outbox_on_disk and self._store is not None:
            new.store_key = self._put(peer, accepted, now)
        kept.append(new)
        self.bytes += len(accepted.payload)
        return gone

    def release(self, peer: str) -> list[Held]:
        """The peer is online: everything held for it, oldest first, leaves the outbox (but not yet the disk)."""
        kept = self._held.pop(peer, [])
        self.bytes -= sum(len(held.accepted.payload) for held in kept)
        return kept

    def settle(self, store_key: int | None) -> None:
        """The outcome is known: the disk may forget it."""
        if store_key is not None and self._store is not None:
            self._store.remove(store_key)

    def expire(self, now: float) -> list[tuple[str, Held]]:
        """(peer, message) of everything past its deadline, removed."""
        late = [
            (peer, held)
            for peer, kept in self._held.items()
            for held in kept
            if held.accepted.deadline is not None and held.accepted.deadline <= now
        ]
        for peer, held in late:
            self._remove(self._held[peer], held)
        return late

    def drop_all(self) -> list[tuple[str, Held]]:
        """At the end of the node: what is only in memory is lost with it; what is on disk stays there."""
        gone = [(peer, held) for peer, kept in self._held.items() for held in kept if held.store_key is None]
        self._held.clear()
        self.bytes = 0
        return gone

    def peers(self) -> list[str]:
        return [peer for peer, kept in self._held.items() if kept]

    def count(self, peer: str) -> tuple[int, int]:
        """(messages, bytes) held for a peer."""
        kept = self._held.get(peer, [])
        return len(kept), sum(len(held.accepted.payload) for held in kept)

    def _remove(self, kept: list[Held], held: Held) -> None:
        kept.remove(held)
        self.bytes -= len(held.accepted.payload)
        self.settle(held.store_key)

    def _put(self, peer: str, accepted: Accepted, now: float) -> int:
        assert self._store is not None
        key = self._next_key
        self._next_key += 1
        remaining = None if accepted.deadline is None else max(0.0, accepted.deadline - now)
        channel = accepted.channel
        self._store.put(StoredMessage(key, peer, channel.topic.name, channel.type_name, accepted.payload, remaining))
        return key
