"""The frames: what one node says to another inside a sealed datagram.

A datagram carries one or more frames. Discovery: `Heartbeat` (to all, or to one peer as an introduction), `Bye`.
Messages: `TopicAnnounce` gives a number to a topic, `Fragment` carries a piece of a message (the first piece carries
the `MessageHead`), `Delivered`, `Refused` and `Cancel` end it. Reliability: `Ack` answers packets, `Nack` asks for
missing pieces of a broadcast. `Ping` and `Pong` prove a path, `Sent` dates a datagram. Fields that come from the wire
have already passed the caps of `limits`; a constructor checks nothing.

Numbers: a *packet number* counts the datagrams of one channel (sender's boot to one receiver's boot, or to all),
starts at 0 and is never used twice; a *message id* counts the messages of one such channel and is the same in every
retransmission.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import NamedTuple, TypeAlias

Payload: TypeAlias = bytes | bytearray | memoryview


class Feature(IntFlag):
    """Optional abilities a node announces; an unknown bit is ignored."""

    ZLIB = 1
    """Takes messages compressed with zlib (RFC 1950)."""
    REPAIR = 2
    """Asks for lost broadcasts with `Nack`, and answers it."""
    TIMED = 4
    """Takes `Sent` and a head's remaining life, stamps what it sends, and answers a ping where it came from."""


class Waiting(NamedTuple):
    """One priority level with something waiting at the speaker; other nodes' lower levels yield to it."""

    priority: int
    """0 (most urgent) to 15."""
    age_ms: int
    """How long its oldest message has waited, at most 65,535 ms."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Who speaks and what it hears. The boot id stands in the datagram's long header, authenticated with it."""

    name: str
    """The node's name, 1 to 63 bytes of UTF-8 without space, control character or slash."""
    min_version: int
    max_version: int
    """Wire versions spoken, 1 to 7."""
    features: int
    """Bits of `Feature`."""
    interval_ms: int
    """When to expect the next one at the latest, 1 to 65,535 ms: heartbeats grow sparser where traffic proves the
    link."""
    known_peers: int
    """Peers online at the speaker."""
    send_rate: int
    """What the speaker sends to everybody, wire bytes/s averaged over about 1 s: how busy the channel is."""
    broadcast_number: int
    """The speaker's next packet number to all; a verified peer accepts no older broadcast packet (replays)."""
    broadcast_messages: int
    """The speaker's next broadcast message id: a receiver that is short of one asks with `Nack`."""
    heard: tuple[bytes, ...] = ()
    """First 8 bytes of the boot ids heard lately: a node finds itself here and knows the link works both ways."""
    waiting: tuple[Waiting, ...] = ()
    clock_ms: int | None = None
    """The speaker's clock as in `Sent`; None where its version does not say."""


class MessageFlag(IntFlag):
    """How a message is to be treated."""

    RELIABLE = 1
    """Retransmitted until delivered, expired or the peer is lost; otherwise best effort."""
    COMPRESSED = 2
    """The bytes are zlib (RFC 1950); the receiver bounds what they may inflate to."""
    TO_ALL = 4
    """Addressed to every node, whichever way this copy came."""
    REPAIR = 8
    """A broadcast that may be asked for again with `Nack`."""


@dataclass(frozen=True, slots=True)
class MessageHead:
    """What the first fragment (position 0) says about its message."""

    size_bytes: int
    """Bytes of the whole message as sent (after compression)."""
    fragments: int
    """Number of fragments, at least 1, none of them empty unless the message is."""
    topic_id: int
    """Number given by a `TopicAnnounce` of the same sender boot, 0 to 65,535."""
    priority: int
    """0 (most urgent) to 15."""
    flags: int
    """Bits of `MessageFlag`."""
    age_ms: int = 0
    """How long ago the message was accepted for sending, when this copy left; up to 2**32-1 ms (49 days)."""
    life_ms: int | None = None
    """How much longer it is worth delivering, when this copy left, at least 1; None: no deadline, or not said."""


class Fragment(NamedTuple):
    """A piece of a message. A NamedTuple because this is the one frame built tens of thousands of times a second."""

    message_id: int
    """32 bits, counts the messages of this channel (or the broadcast channel, see `broadcast_id`)."""
    position: int
    """0 to fragments - 1."""
    payload: Payload
    """The bytes; a decoded fragment's is a view into its datagram."""
    head: MessageHead | None = None
    """Present exactly where position is 0."""
    ack_now: bool = False
    """Acknowledge at once, do not wait to batch (urgent messages, the last fragments in flight)."""
    broadcast_id: bool = False
    """In a unicast datagram: `message_id` counts in the sender's broadcast channel (repair, or per-peer copy of it)."""


class Ack(NamedTuple):
    """Which packets of the reverse channel arrived."""

    largest: int
    """Largest packet number received (48 bits)."""
    received: int
    """256-bit bitmap: bit i set means packet `largest - 1 - i` arrived. Bits below packet 0 are clear."""
    delay_us: int
    """From the arrival of `largest` to this acknowledgement's sending, at most 2**24-1 us."""
    receive_rate: int
    """Wire bytes/s arriving at the speaker from this peer, averaged over about 1 s (0 = none, or not known yet)."""
    waiting: tuple[Waiting, ...] = ()


@dataclass(frozen=True, slots=True)
class Delivered:
    """These messages are complete and handed over at the receiver."""

    message_ids: tuple[int, ...]
    broadcast_ids: bool = False


class RefuseReason(IntEnum):
    TOO_LARGE = 1
    """Larger than the receiver's configured limit."""
    NO_MEMORY = 2
    """The receiver's reassembly memory for this sender is full: try again later."""
    CORRUPT = 3
    """The bytes do not decompress, or the fragments contradict their head."""
    FORGOTTEN = 4
    """The receiver no longer has the fragments it acknowledged (or the topic's name): send the message anew."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The receiver will not take this message."""

    message_id: int
    reason: RefuseReason
    broadcast_id: bool = False


@dataclass(frozen=True, slots=True)
class Cancel:
    """The sender gives these messages up (expired, replaced by a newer one): forget the parts."""

    message_ids: tuple[int, ...]
    broadcast_ids: bool = False


@dataclass(frozen=True, slots=True)
class Nack:
    """Pieces missing of one broadcast message; no ranges: all of it."""

    message_id: int
    ranges: tuple[tuple[int, int], ...] = ()
    """(first position, count >= 1) each."""


@dataclass(frozen=True, slots=True)
class TopicAnnounce:
    """Gives a number to a topic, for the life of the sender's boot."""

    topic_id: int
    name: str
    """1 to 255 bytes of UTF-8."""
    type_name: str = ""
    """Opaque to the transport, up to 255 bytes."""


@dataclass(frozen=True, slots=True)
class Ping:
    token: int
    """64 bits, returned by the `Pong`."""


@dataclass(frozen=True, slots=True)
class Pong:
    token: int
    held_us: int
    """From the ping's arrival to this answer, at most 2**32-1 us."""


@dataclass(frozen=True, slots=True)
class Sent:
    """When this datagram left, by the sender's own clock: only differences mean something."""

    clock_ms: int
    """Milliseconds, modulo 2**32."""


@dataclass(frozen=True, slots=True)
class Bye:
    """The speaker stops in order; peers report it offline at once."""

    reason: str = ""


Frame: TypeAlias = (
    Heartbeat | Fragment | Ack | Delivered | Refused | Cancel | Nack | TopicAnnounce | Ping | Pong | Bye | Sent
)
