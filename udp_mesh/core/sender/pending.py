"""The messages for one peer that have no outcome yet: accepted -> replaced, expired or restarted -> ended, once each.

`sender` handles their fragments in flight.
"""

from collections.abc import Iterable
from enum import Enum
from heapq import heapify, heappop, heappush
from typing import NamedTuple

from udp_mesh.core.events import ExpiryReason
from udp_mesh.core.sender.level_stats import PriorityLevels
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.send_memory import SendMemory


class Outcome(Enum):
    """How a message ended, other than by expiring."""

    DELIVERED = 1
    SENT = 2
    """Best effort: sent; no outcome is reported."""
    PEER_LOST = 3


class Ended(NamedTuple):
    message: OutgoingMessage
    outcome: Outcome | ExpiryReason


CONFIRM_INTERVAL_S, MAX_CONFIRM_INTERVAL_S = 1.0, 60.0
"""How long a confirmation is awaited before it is asked for, the first time and at most: a disk may be slow."""


class Unconfirmed:
    """A message that arrived completely."""

    __slots__ = ("_at", "_interval_s", "message")

    def __init__(self, message: OutgoingMessage) -> None:
        self.message = message
        self._at: float | None = None
        self._interval_s = CONFIRM_INTERVAL_S

    def is_due(self, now: float) -> bool:
        """Whether to ask now. Asks at growing intervals from the first call on."""
        if self._at is None:
            self._at = now + self._interval_s
        if now < self._at:
            return False
        self._interval_s = min(2 * self._interval_s, MAX_CONFIRM_INTERVAL_S)
        self._at = now + self._interval_s
        return True


class PendingMessages:
    """The session fetches and clears `ended` and `cancelled`."""

    def __init__(self, memory: SendMemory, peer: str) -> None:
        self.pending: dict[OutgoingMessage, None] = {}
        """Messages without an outcome, in the order accepted."""
        self.levels = PriorityLevels(memory, peer)
        self.ended: list[Ended] = []
        self.cancelled: list[int] = []
        """Wire ids abandoned after their first fragment was sent: the peer may discard them."""
        self._deadlines: list[tuple[float, int, OutgoingMessage]] = []
        self._deadline_serial = 0
        self.unconfirmed: dict[int, Unconfirmed] = {}
        """By wire id: messages that arrived completely, until the peer confirms that they are safe."""
        self._kept: dict[str, list[OutgoingMessage]] = {}
        """Pending messages of topics with `keep_last`."""

    def add(self, message: OutgoingMessage) -> None:
        """Add a message. Older ones beyond its topic's `keep_last` end now, or when their sent fragments are
        acknowledged or lost."""
        self.pending[message] = None
        self.levels.add(message)
        self._note_deadline(message)
        keep_last = message.accepted.channel.topic.keep_last
        if keep_last is not None:
            self._replace_older(message, keep_last)

    def _note_deadline(self, message: OutgoingMessage) -> None:
        if message.accepted.deadline is not None:
            self._deadline_serial += 1
            heappush(self._deadlines, (message.accepted.deadline, self._deadline_serial, message))
            if len(self._deadlines) > 64 + 2 * len(self.pending):
                # Free messages that ended long before their deadline.
                self._deadlines = [entry for entry in self._deadlines if not entry[2].ended]
                heapify(self._deadlines)

    def _replace_older(self, message: OutgoingMessage, keep_last: int) -> None:
        kept = self._kept.get(message.accepted.channel.topic.name, [])
        recent = [older for older in kept if not older.ended and not older.superseded]
        recent.append(message)
        self._kept[message.accepted.channel.topic.name] = recent
        for older in recent[: max(0, len(recent) - keep_last)]:
            if not older.started:
                self.finish(older, ExpiryReason.SUPERSEDED)
            elif older.small:
                # Its fragments may be arriving right now; their fate decides how it ends.
                older.superseded = True

    def next_deadline(self) -> float | None:
        """When the next message expires (it may have ended meanwhile)."""
        return self._deadlines[0][0] if self._deadlines else None

    def expire(self, now: float, ack_wait_s: float = 0.0) -> None:
        """End messages whose deadline has passed. One of which every fragment was sent may have arrived in time: it has
        `ack_wait_s` more for the acknowledgement to come."""
        while self._deadlines and self._deadlines[0][0] <= now:
            at, serial, message = heappop(self._deadlines)
            all_sent = message.started and message.next_position >= message.fragments
            if ack_wait_s and all_sent and not message.overdue and not message.ended:
                message.overdue = True
                heappush(self._deadlines, (at + ack_wait_s, serial, message))
            else:
                self.finish(message, ExpiryReason.DEADLINE)

    def restart_message(self, message: OutgoingMessage) -> OutgoingMessage:
        """Replace the message by a copy of which nothing was sent, placed last on its level."""
        message.ended = True
        self.pending.pop(message, None)
        copy = message.restarted()
        self.pending[copy] = None
        self.levels.append(copy)
        self._note_deadline(copy)
        kept = self._kept.get(copy.accepted.channel.topic.name)
        if kept is not None:
            kept.append(copy)
        return copy

    def finish(self, message: OutgoingMessage, outcome: Outcome | ExpiryReason) -> None:
        """Set the outcome of a message. Later outcomes are ignored."""
        if message.ended:
            return
        self._remove(message)
        if message.started and outcome is not Outcome.DELIVERED and outcome is not Outcome.SENT:
            self.cancel(message)
        self.ended.append(Ended(message, outcome))

    def finish_all(self, outcome: Outcome | ExpiryReason) -> None:
        for message in list(self.pending):
            self.finish(message, outcome)

    def withdraw(self, message: OutgoingMessage, *, to_resume: bool = False) -> None:
        """Remove a message without an outcome because an outbox keeps it; with `to_resume`, it keeps its wire id."""
        if not message.ended:
            self._remove(message)
            if message.started and not to_resume:
                self.cancel(message)

    def _remove(self, message: OutgoingMessage) -> None:
        message.ended = True
        del self.pending[message]
        self.levels.remove(message)

    def cancel(self, message: OutgoingMessage) -> None:
        """Tell the peer to discard what it has of this message."""
        if message.wire_id is not None and message.accepted.broadcast_number is None:
            self.cancelled.append(message.wire_id)

    def on_arrived(self, message: OutgoingMessage) -> None:
        """All of the message's fragments are acknowledged."""
        if not message.confirm or message.wire_id is None:
            self.finish(message, Outcome.DELIVERED)
            return
        entry = self.unconfirmed.get(message.wire_id)
        if entry is None or entry.message is not message:
            # Perhaps resumed: then the entry of the withdrawn message is replaced.
            self.unconfirmed[message.wire_id] = Unconfirmed(message)

    def confirmations_due(self, now: float) -> list[OutgoingMessage]:
        """Messages of which a fragment is to be sent again, so that the peer repeats a confirmation that was lost."""
        due = []
        for wire_id, entry in list(self.unconfirmed.items()):
            if entry.message.ended:
                del self.unconfirmed[wire_id]
            elif entry.is_due(now):
                due.append(entry.message)
        return due

    def by_wire_id(self, wire_id: int) -> OutgoingMessage | None:
        """The pending message with this wire id (broadcast repairs are numbered separately). A linear search, for rare
        frames."""
        own = (message for message in self.pending if message.accepted.broadcast_number is None)
        return next((message for message in own if message.wire_id == wire_id), None)

    def by_broadcast_number(self, number: int) -> OutgoingMessage | None:
        """The pending repair of this broadcast. A linear search as well."""
        return next((message for message in self.pending if message.accepted.broadcast_number == number), None)

    def on_delivered(self, wire_ids: Iterable[int]) -> None:
        """The peer reports these messages as complete, whatever it acknowledged. A linear search, for other
        implementations."""
        known = set(wire_ids)
        for wire_id in known & self.unconfirmed.keys():
            self.finish(self.unconfirmed.pop(wire_id).message, Outcome.DELIVERED)
            known.discard(wire_id)
        if not known:
            return
        for message in list(self.pending):
            if message.wire_id in known and message.accepted.broadcast_number is None:
                self.finish(message, Outcome.DELIVERED)
