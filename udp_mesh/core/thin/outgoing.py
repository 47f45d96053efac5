"""A message on its way over thin links: its parts, who is to acknowledge it, and what one link still has to send.

A link sends the parts once. If the message is reliable, it sends what a receiver lacks again, at growing intervals,
until all have acknowledged it, over whatever link, or its time is over.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

from udp_mesh.core.events import MessageId
from udp_mesh.wire.limits import MAX_THIN_PARTS
from udp_mesh.wire.thin import Part, ThinBody

LIFE_S = 120.0
"""How long a message without a deadline is tried; an urgent one for all reaches who appears within this time."""
MAX_ATTEMPTS = 10
MAX_URGENT_ATTEMPTS = 30
UNHEARD_ATTEMPTS = 4
"""How often an urgent message is sent if no node is known that could acknowledge it."""


@dataclass(slots=True, eq=False)
class ThinMessage:
    """One message, shared by the links that carry it."""

    number: int
    """Modulo 2**16, the same in all copies, also in those that are sent as datagrams."""
    message_id: MessageId
    topic: str
    topic_hash: bytes
    priority: int
    urgent: bool
    reliable: bool
    destination: int | None
    parts: tuple[bytes, ...]
    accepted_at: float
    ends_at: float
    not_before: float = 0.0
    alone: ThinBody | None = None
    """The message itself, while only thin links carry it: its outcome is reported here."""
    lacking: dict[int, int] = field(default_factory=dict)
    """Number of each receiver that has not acknowledged it -> bits of the parts that it has."""
    acknowledged: set[int] = field(default_factory=set)
    ended: bool = False

    def part(self, index: int) -> Part:
        """One part as an item."""
        topic = self.topic_hash if index == 0 else None
        count = len(self.parts)
        return Part(self.number, self.priority, self.reliable, self.destination, index, count, topic, self.parts[index])

    def missing(self) -> list[int]:
        """The parts that some receiver lacks; all, if no receiver is known."""
        everywhere = -1
        for bits in self.lacking.values():
            everywhere &= bits
        return [index for index in range(len(self.parts)) if not self.lacking or not everywhere >> index & 1]

    def add_receiver(self, number: int) -> bool:
        """A node is to acknowledge it. False if it has, or is known already."""
        if number in self.acknowledged or number in self.lacking or not self.reliable:
            return False
        self.lacking[number] = 0
        return True

    @property
    def is_for_strangers(self) -> bool:
        """Whether nodes may lack it that are not known here yet, as in the first minutes of a large team."""
        return self.urgent and self.destination is None

    @property
    def max_attempts(self) -> int:
        """How often a link sends it."""
        if not self.lacking:
            return UNHEARD_ATTEMPTS
        return MAX_URGENT_ATTEMPTS if self.urgent else MAX_ATTEMPTS

    @property
    def is_answered(self) -> bool:
        """Whether all known receivers have acknowledged it."""
        return self.reliable and bool(self.acknowledged) and not self.lacking


@dataclass(slots=True, eq=False)
class LinkQueueEntry:
    """The parts of a message that one link has to send."""

    message: ThinMessage
    to_send: deque[int]
    attempts: int = 0
    retry_at: float = float("inf")

    def ready_at(self) -> float:
        """When there is something to send."""
        return self.message.not_before if self.to_send else self.retry_at

    def repeat(self) -> None:
        """Send what is missing once more."""
        self.to_send = deque(self.message.missing())
        self.retry_at = float("inf")


def divide(joined: bytes, part_bytes: int) -> tuple[bytes, ...] | None:
    """The parts of a message; None if they are too many."""
    parts = tuple(joined[at : at + part_bytes] for at in range(0, len(joined), part_bytes)) or (b"",)
    return parts if len(parts) <= MAX_THIN_PARTS else None
