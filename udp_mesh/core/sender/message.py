"""One message for one peer: its bytes, which fragments were sent and acknowledged, and how it is treated."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from udp_mesh.core.events import MessageId
from udp_mesh.core.settings import Topic

MAX_SMALL_FRAGMENTS = 3
"""An urgent message of at most this many fragments is worth sending twice, and a newer message may replace it after its
first fragment was sent."""


class TopicChannel:
    """A topic as this node announces it: its number on the wire, its type and its current settings.

    Replacing `topic` applies changed settings to messages already accepted.
    """

    __slots__ = ("name", "number", "topic", "type_name")

    def __init__(self, number: int, topic: Topic, name: str, type_name: str) -> None:
        self.number = number
        self.topic = topic
        self.name = name
        self.type_name = type_name


class AcceptedMessage(NamedTuple):
    """A message accepted by `Endpoint.send`, shared by the copies for every destination. A tuple, because thousands are
    made a second."""

    message_id: MessageId
    channel: TopicChannel
    payload: bytes
    """The bytes passed to `send`."""
    body: bytes
    """The bytes on the wire (compressed or not)."""
    flags: int
    """Bits of `MessageFlag`."""
    accepted_at: float
    deadline: float | None
    broadcast_number: int | None = None
    """The broadcast message id that this message repairs."""

    def life_ms(self, now: float) -> int | None:
        """Remaining lifetime for the message head. None: no deadline."""
        return None if self.deadline is None else max(1, int((self.deadline - now) * 1000))


class MessageVersion(Protocol):
    """How a message is sent as a version of its topic (`versions.outgoing`)."""

    whole: bool
    prepared: bool
    digest: bytes
    is_difference: bool

    def prepare(self, message: OutgoingMessage, epoch: int, *, accepted: bool, now: float) -> bool: ...

    def restarted(self) -> MessageVersion: ...

    def on_delivered(self, message: OutgoingMessage) -> None: ...

    def on_fragment_arrived(self, message: OutgoingMessage, position: int) -> None: ...

    def on_refused(self, message: OutgoingMessage) -> None: ...


class OutgoingMessage:
    """The copy for one peer. `wire_id` is None until its first fragment is sent."""

    __slots__ = (
        "accepted",
        "arrived",
        "body",
        "confirm",
        "ended",
        "first_bytes",
        "flags",
        "fragment_bytes",
        "fragments",
        "missing",
        "next_position",
        "overdue",
        "priority",
        "queued_at",
        "queued_bytes",
        "reliable",
        "store_key",
        "superseded",
        "version",
        "wire_id",
    )

    def __init__(self, accepted: AcceptedMessage, priority: int, *, reliable: bool) -> None:
        self.accepted = accepted
        self.body = accepted.body
        self.flags = accepted.flags
        """Bits of `MessageFlag`. Like `body`, they change when the message is sent as a version of its topic."""
        self.version: MessageVersion | None = None
        """Set if the topic's messages are sent as differences."""
        self.queued_bytes = len(accepted.body)
        """What it counts for in the statistics of its level, whatever becomes of its body."""
        self.priority = priority
        self.reliable = reliable
        self.queued_at = accepted.accepted_at
        self.store_key: int | None = None
        self.confirm = False
        """It ends as delivered only when the peer confirms that, not when its fragments are acknowledged."""
        self.ended = False
        self.overdue = False
        """Past its deadline: only its acknowledgment is awaited."""
        self.superseded = False
        """Replaced by a newer message: its lost fragments are not retransmitted."""
        self.wire_id: int | None = None
        self.fragment_bytes = 0
        self.first_bytes = 0
        self.fragments = 1
        self.next_position = 0
        self.missing = 1
        """Fragments not yet acknowledged."""
        self.arrived = bytearray()
        """1 per acknowledged position. Has one byte per fragment once the message has started."""

    def begin(self, wire_id: int, fragment_bytes: int, first_bytes: int) -> None:
        """Assign the wire id and fragment sizes. The first fragment carries less, because of the head."""
        self.wire_id = wire_id
        self.fragment_bytes = fragment_bytes
        size = len(self.body)
        if size <= first_bytes:
            self.first_bytes = size
            self.fragments = 1
        else:
            self.first_bytes = first_bytes
            self.fragments = 1 - (first_bytes - size) // fragment_bytes
        self.missing = self.fragments
        self.arrived = bytearray(self.fragments)

    def span(self, position: int) -> tuple[int, int]:
        """(start, end) of a fragment within the body."""
        if position == 0:
            return 0, min(self.first_bytes, len(self.body))
        start = self.first_bytes + (position - 1) * self.fragment_bytes
        return start, min(start + self.fragment_bytes, len(self.body))

    def restarted(self) -> OutgoingMessage:
        """The same message with nothing sent: the peer lost what it had. The caller marks this one ended."""
        copy = OutgoingMessage(self.accepted, self.priority, reliable=self.reliable)
        copy.store_key = self.store_key
        copy.queued_bytes = self.queued_bytes
        copy.version = None if self.version is None else self.version.restarted()
        return copy

    def resumed(self) -> OutgoingMessage:
        """The same message under the same wire id, with its acknowledged fragments. The caller marks this one ended."""
        copy = OutgoingMessage(self.accepted, self.accepted.channel.topic.priority, reliable=self.reliable)
        copy.store_key = self.store_key
        copy.body, copy.flags, copy.version = self.body, self.flags, self.version
        assert self.wire_id is not None
        copy.begin(self.wire_id, self.fragment_bytes, self.first_bytes)
        copy.confirm = self.confirm
        copy.arrived, copy.missing, copy.next_position = self.arrived, self.missing, self.next_position
        return copy

    @property
    def started(self) -> bool:
        return self.wire_id is not None

    @property
    def small(self) -> bool:
        """Few fragments. Known once the message has started."""
        return self.fragments <= MAX_SMALL_FRAGMENTS

    def mark_arrived(self, position: int) -> bool:
        """Record an acknowledged fragment. True if it was not acknowledged before."""
        if self.arrived[position]:
            return False
        self.arrived[position] = 1
        self.missing -= 1
        return True
