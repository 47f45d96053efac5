"""The receiving half of a session: opened datagrams in -> complete messages, acknowledgments and refusals out.

1. `receive_fragment` processes a fragment; a plain full fragment takes the fast path without building a frame.
2. Fragments go to the reassembly of the channel they are numbered in (the sender's unicasts or its broadcasts).
3. A datagram is acknowledged only if all of its fragments were accepted; otherwise it is retransmitted.
"""

from collections import deque
from typing import NamedTuple

from udp_mesh.core.compression import Decompression, start_decompression
from udp_mesh.core.receiver.acks import MAX_PENDING, AckState
from udp_mesh.core.receiver.memory_limit import TOPIC_BYTES, Account, MemoryBudget
from udp_mesh.core.receiver.reassembly import CompleteMessage, FragmentStatus, Reassembly
from udp_mesh.core.sender.sent_packets import REORDER_PACKETS
from udp_mesh.core.settings import Limits, Rates
from udp_mesh.core.thin.numbering import split_number
from udp_mesh.core.versions.decoding import VersionDecoding
from udp_mesh.core.versions.received import CounterTable, ReceivedVersions
from udp_mesh.core.zstd import ZstdDecompression
from udp_mesh.wire.fragment import (
    FRAGMENT,
    FRAGMENT_ACK_NOW,
    FRAGMENT_BYTES,
    FRAGMENT_WIDE,
    FRAGMENT_WIDE_BYTES,
    NARROW_HEADER,
    WIDE_HEADER,
)
from udp_mesh.wire.frames import Fragment, MessageFlag, Refused, RefuseReason, TopicAnnounce

_PLAIN_MASK = 0xFF & ~FRAGMENT_ACK_NOW

MAX_UNCONFIRMED = 4096
"""Messages of one peer that the application has not confirmed yet; the next ones are not acknowledged."""

MAX_REFUSED_REMEMBERED = 256
"""Refused messages of one peer remembered, so that each of their fragments is refused again."""


_Key = tuple[bool, int]
"""Whether the message is numbered as a broadcast, and its number."""


class ReceivedMessage(NamedTuple):
    """A complete message for the application."""

    topic: str
    type_name: str
    payload: bytes
    priority: int
    to_all: bool
    from_broadcast: int | None
    """Its broadcast number, if it has one."""
    confirm_id: int | None = None
    """Its message id, if its sender waits for a confirmation."""
    thin_number: int | None = None
    """The number that its copies on thin links have, if there may be any."""


class Inflating(NamedTuple):
    """A complete message being inflated, with everything but its payload."""

    work: Decompression | ZstdDecompression | VersionDecoding
    message: ReceivedMessage
    key: _Key
    reserved_bytes: int
    numbers: list[int]
    """Packets to acknowledge once the version is decoded."""


def _asks_to_confirm(fragment: Fragment) -> bool:
    head = fragment.head
    return head is not None and head.flags & MessageFlag.CONFIRM != 0 and not fragment.broadcast_id


def _is_version(inflating: Inflating) -> bool:
    return isinstance(inflating.work, VersionDecoding)


def _topic_bytes(names: tuple[str, str]) -> int:
    return TOPIC_BYTES + sum(len(name) for name in names)


class Receiver:
    """The session fetches and clears `completed` and `refusals`."""

    __slots__ = (
        "_account",
        "_asked_again",
        "_gap_ack_at",
        "_limits",
        "_rates",
        "_refused",
        "acks",
        "broadcasts",
        "completed",
        "confirmed",
        "deferred",
        "duplicates",
        "expired",
        "fragments",
        "inflating",
        "over_limit",
        "refusals",
        "topics",
        "unconfirmed",
        "unicasts",
        "versions",
    )

    def __init__(self, rates: Rates, limits: Limits, memory: MemoryBudget) -> None:
        self._rates = rates
        self._limits = limits
        self.acks = AckState()
        self._account = Account(memory)
        self.unicasts = Reassembly(limits, self._account)
        self.broadcasts = Reassembly(limits, self._account)
        self.topics: dict[int, tuple[str, str]] = {}
        self.completed: list[ReceivedMessage] = []
        self.refusals: list[Refused] = []
        self.inflating: deque[Inflating] = deque()
        self.versions = ReceivedVersions(limits, MemoryBudget(limits.version_bytes_per_peer), CounterTable())
        self.deferred: Inflating | None = None
        """A version that the datagram being processed completed: it is acknowledged once the version is decoded."""
        self.duplicates = 0
        self.expired = 0
        """Fragments of messages that their senders have given up by now."""
        self.fragments = 0
        self.over_limit = 0
        self.unconfirmed: set[int] = set()
        """Delivered messages whose senders wait for a confirmation."""
        self.confirmed: list[int] = []
        """Confirmations to send."""
        self._asked_again: dict[int, None] = {}
        """Messages that could not be kept: should the refusal be lost, each of their fragments is refused again."""
        self._refused: dict[tuple[bool, int], RefuseReason] = {}
        self._gap_ack_at: int | None = None

    @property
    def partial_bytes(self) -> int:
        return self.unicasts.bytes + self.broadcasts.bytes

    @property
    def inflating_bytes(self) -> int:
        return sum([inflating.work.held_bytes for inflating in self.inflating])

    def apply(self, rates: Rates, limits: Limits) -> None:
        self._rates, self._limits = rates, limits
        self.unicasts.set_limits(limits)
        self.broadcasts.set_limits(limits)
        self.versions.apply(limits)

    def receive_plain(self, frames: bytes, number: int, now: float) -> bool:
        """The fast path: one fragment without a head that fills its datagram. False for anything else."""
        first = frames[0]
        kind = first & _PLAIN_MASK
        if kind == FRAGMENT and len(frames) > FRAGMENT_BYTES:
            _, message_id, position = NARROW_HEADER.unpack_from(frames)
            payload = frames[FRAGMENT_BYTES:]
        elif kind == FRAGMENT | FRAGMENT_WIDE and len(frames) > FRAGMENT_WIDE_BYTES:
            _, message_id, position = WIDE_HEADER.unpack_from(frames)
            payload = frames[FRAGMENT_WIDE_BYTES:]
        else:
            return False
        if not position or (self._refused and (False, message_id) in self._refused):
            return False
        if not self.unicasts.add_plain(message_id, position, payload):
            return False
        self.fragments += 1
        self.on_accepted(number, now, ack_now=first != kind)
        return True

    def on_topic_announce(self, frame: TopicAnnounce) -> None:
        """Store a topic's number. Bounded, because a faulty peer may announce topics without end."""
        names = (frame.name, frame.type_name)
        known = self.topics.get(frame.topic_id)
        if known == names:
            return
        size = _topic_bytes(names)
        if (known is None and len(self.topics) >= self._limits.topics_per_peer) or not self._account.has_room(size):
            self.over_limit += 1
            return
        self._account.reserve(size - (0 if known is None else _topic_bytes(known)))
        self.topics[frame.topic_id] = names

    def close(self) -> None:
        """Release what is held for a dropped peer."""
        self._account.close()
        self.versions.held.close()

    def receive_fragment(self, fragment: Fragment, now: float, *, broadcast: bool, late_s: float = 0.0) -> bool:
        """Process one fragment that was delayed by `late_s`. False if it was refused, so that its datagram must not be
        acknowledged."""
        by_broadcast = broadcast or fragment.broadcast_id
        self.fragments += 1
        key = (by_broadcast, fragment.message_id)
        if self._refused and key in self._refused:
            self._refuse(key, self._refused[key])
            return False
        if len(self.unconfirmed) >= MAX_UNCONFIRMED and _asks_to_confirm(fragment):
            self.over_limit += 1
            return False
        reassembly = self.broadcasts if by_broadcast else self.unicasts
        result = reassembly.add(fragment, now, late_s)
        if isinstance(result, CompleteMessage):
            return self._deliver(result, by_broadcast)
        match result:
            case FragmentStatus.KEPT:
                return True
            case FragmentStatus.DUPLICATE:
                self.duplicates += 1
                if any(inflating.key == key for inflating in self.inflating if _is_version(inflating)):
                    return False
                if not _asks_to_confirm(fragment):
                    return True
                if fragment.message_id in self._asked_again:
                    self._refuse(key, RefuseReason.FORGOTTEN)
                    return False
                if self._is_confirmed(fragment.message_id):
                    # The confirmation was lost.
                    self.confirmed.append(fragment.message_id)
                return True
            case FragmentStatus.FULL:
                self.over_limit += 1
                return False
            case FragmentStatus.EXPIRED:
                self.expired += 1
                return False
            case FragmentStatus.FORGOTTEN:
                if not by_broadcast and fragment.message_id in self.unconfirmed:
                    # It arrived long ago and waits for its program.
                    return True
                self._refuse(key, RefuseReason.FORGOTTEN)
                return False
            case FragmentStatus.TOO_LARGE:
                self.over_limit += 1
                self._refuse_for_good(key, RefuseReason.TOO_LARGE)
                return False
            case FragmentStatus.CORRUPT:
                self._refuse_for_good(key, RefuseReason.CORRUPT)
                return False

    def confirm(self, message_id: int) -> bool:
        """The message is safe. False if that is not awaited."""
        if message_id not in self.unconfirmed:
            return False
        self.unconfirmed.remove(message_id)
        self.confirmed.append(message_id)
        return True

    def request_again(self, message_id: int) -> bool:
        """The message could not be kept: its sender is to restart it. False if that is not awaited."""
        if message_id not in self.unconfirmed:
            return False
        self.unconfirmed.remove(message_id)
        self._asked_again[message_id] = None
        if len(self._asked_again) > MAX_UNCONFIRMED:
            del self._asked_again[next(iter(self._asked_again))]
        self._refuse((False, message_id), RefuseReason.FORGOTTEN)
        return True

    def _is_confirmed(self, message_id: int) -> bool:
        return message_id in self.unicasts.finished and message_id not in self.unconfirmed

    def on_accepted(self, number: int, now: float, *, ack_now: bool) -> None:
        """Record that a datagram that requests an acknowledgment was accepted."""
        acks = self.acks
        acks.requested += ack_now
        if number > acks.largest + 1:
            # A gap: the sender can declare a loss once three later packets arrived, so acknowledge then.
            if self._gap_ack_at is None:
                self._gap_ack_at = number + REORDER_PACKETS - 1
            ack_now = ack_now or acks.largest < 0
        acks.on_packet(number, now)
        acks.pending += 1
        if self._gap_ack_at is not None and number >= self._gap_ack_at:
            ack_now = True
        if ack_now or acks.pending >= self._rates.ack_every_packets:
            acks.send_now = True
            self._gap_ack_at = None
        elif acks.due_at is None:
            acks.due_at = now + self._rates.ack_delay_s

    def ack_overdue(self) -> bool:
        """Whether so many packets are pending that an acknowledgment must be built before more arrive."""
        return self.acks.pending >= MAX_PENDING

    def _deliver(self, complete: CompleteMessage, by_broadcast: bool) -> bool:
        head = complete.head
        key = (by_broadcast, complete.message_id)
        topic = self.topics.get(head.topic_id)
        if topic is None:
            self._refuse(key, RefuseReason.FORGOTTEN)
            return False
        split = split_number(head.flags, complete.body)
        if split is None:
            self._refuse_for_good(key, RefuseReason.CORRUPT)
            return False
        thin_number, body = split
        number = complete.message_id if by_broadcast else None
        to_all = by_broadcast or bool(head.flags & MessageFlag.TO_ALL)
        confirm_id = complete.message_id if head.flags & MessageFlag.CONFIRM and not by_broadcast else None
        received = ReceivedMessage(*topic, body, head.priority, to_all, number, confirm_id, thin_number)
        work: Decompression | ZstdDecompression | VersionDecoding
        if head.flags & MessageFlag.VERSION:
            begun = self.versions.begin(topic, body, head.flags)
            if isinstance(begun, RefuseReason):
                # The sender restarts it under another number; this one stays refused, should the refusal be lost.
                self._refuse_for_good(key, begun)
                return False
            work = begun
        elif head.flags & MessageFlag.COMPRESSED:
            work = start_decompression(body, head.flags, self._limits.message_bytes)
        else:
            return self._complete(received)
        inflating = Inflating(work, received, key, len(body), [])
        if work.step():
            return self._finish_inflating(inflating)
        if self.inflating_bytes + work.held_bytes > self._limits.partial_bytes_per_peer or not self._account.has_room(
            inflating.reserved_bytes
        ):
            self.over_limit += 1
            self._refuse_for_good(key, RefuseReason.TOO_LARGE)
            return False
        self._account.reserve(inflating.reserved_bytes)
        self.inflating.append(inflating)
        if _is_version(inflating):
            self.deferred = inflating
        return True

    def take_deferred(self) -> Inflating | None:
        """The version that the datagram being processed completed, if it is decoded in steps."""
        deferred, self.deferred = self.deferred, None
        return deferred

    def inflate_step(self, now: float) -> bool:
        """Inflate more of the first waiting message. False if it turned out to be corrupt, or, if it is a version, was
        refused.

        The fragments of a message that is not a version are already acknowledged: only a faulty peer sends what cannot
        be inflated.
        """
        inflating = self.inflating[0]
        if not inflating.work.step():
            return True
        self.inflating.popleft()
        self._account.release(inflating.reserved_bytes)
        if not self._finish_inflating(inflating):
            return False
        for number in inflating.numbers:
            self.on_accepted(number, now, ack_now=True)
        return True

    def _finish_inflating(self, inflating: Inflating) -> bool:
        work, message, key = inflating.work, inflating.message, inflating.key
        if isinstance(work, VersionDecoding):
            result = self.versions.finish((message.topic, message.type_name), work, inflating.reserved_bytes)
            if isinstance(result, RefuseReason):
                self._refuse_for_good(key, result)
                return False
            return self._complete(message._replace(payload=result))
        if work.payload is None:
            self._refuse_for_good(key, RefuseReason.CORRUPT)
            return False
        return self._complete(message._replace(payload=work.payload))

    def _complete(self, message: ReceivedMessage) -> bool:
        if message.confirm_id is not None:
            self.unconfirmed.add(message.confirm_id)
        self.completed.append(message)
        return True

    def _refuse(self, key: tuple[bool, int], reason: RefuseReason) -> None:
        broadcast, message_id = key
        refusal = Refused(message_id, reason, broadcast)
        if refusal not in self.refusals:
            self.refusals.append(refusal)

    def _refuse_for_good(self, key: tuple[bool, int], reason: RefuseReason) -> None:
        if len(self._refused) >= MAX_REFUSED_REMEMBERED:
            del self._refused[next(iter(self._refused))]
        self._refused[key] = reason
        self._refuse(key, reason)
