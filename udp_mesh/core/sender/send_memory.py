"""One memory budget for all messages that wait to be sent, to all peers together.

A message to several peers waits in several queues, but its bytes are in memory once; they are counted until the last
copy has ended. A full budget refuses new messages and never drops an accepted one:

- Until half of the budget is used, no peer is limited by it.
- In the second half each peer that something waits for has an equal share, so that a peer that takes nothing leaves
  room for the others.
- Urgent messages have another quarter for themselves: no amount of bulk makes a node refuse them.
"""

from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import AcceptedMessage

COPY_BYTES = 600
"""Overhead of a waiting message for one peer, besides its bytes: measured, objects and dictionary entries."""

URGENT_EXTRA_FRACTION = 4
"""One part in so many of each limit on what waits is added to it for urgent messages."""


def with_urgent_extra(limit: int, *, urgent: bool) -> int:
    """A limit on what waits, as it applies to urgent messages or to others."""
    return limit + limit // URGENT_EXTRA_FRACTION if urgent else limit


class SendMemory:
    """Only counts: queues and outboxes call `add` and `remove`, each at a cost that does not depend on the number of
    peers."""

    __slots__ = ("_by_peer", "_messages", "bytes", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.bytes = 0
        self._messages: dict[MessageId, tuple[int, int]] = {}
        """Number of copies, and bytes of the message itself."""
        self._by_peer: dict[str, int] = {}
        """Bytes that wait for each peer, overhead included; only peers that something waits for."""

    def add(self, peer: str, accepted: AcceptedMessage) -> None:
        """Count the copy for one peer."""
        found = self._messages.get(accepted.message_id)
        if found is None:
            size = len(accepted.payload)
            if accepted.body is not accepted.payload:
                size += len(accepted.body)
            self._messages[accepted.message_id] = (1, size)
            self.bytes += size + COPY_BYTES
        else:
            size = found[1]
            self._messages[accepted.message_id] = (found[0] + 1, size)
            self.bytes += COPY_BYTES
        self._by_peer[peer] = self._by_peer.get(peer, 0) + size + COPY_BYTES

    def remove(self, peer: str, accepted: AcceptedMessage) -> None:
        """Stop counting the copy for one peer."""
        copies, size = self._messages[accepted.message_id]
        if copies == 1:
            del self._messages[accepted.message_id]
            self.bytes -= size + COPY_BYTES
        else:
            self._messages[accepted.message_id] = (copies - 1, size)
            self.bytes -= COPY_BYTES
        left = self._by_peer[peer] - size - COPY_BYTES
        if left:
            self._by_peer[peer] = left
        else:
            del self._by_peer[peer]

    def waiting_bytes(self, peer: str) -> int:
        """What waits for one peer, in its queue and its outboxes, overhead included."""
        return self._by_peer.get(peer, 0)

    def share(self) -> int:
        """What each peer that something waits for may hold in the second half of the budget."""
        return self.limit // 2 // max(1, len(self._by_peer))
