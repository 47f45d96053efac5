"""The frames inside a sealed datagram.

A datagram carries one or more frames. Discovery: `Heartbeat` (to all, or to one peer as an introduction), `Bye`.
Messages: `TopicAnnounce` assigns a number to a topic, `Fragment` carries a part of a message (the first one with its
`MessageHead`), `Delivered`, `Refused` and `Cancel` end it. Reliability: `Ack` acknowledges packets, `Nack` requests
missing fragments of a broadcast. `Ping` and `Pong` validate a path, `Sent` timestamps a datagram. Fields from the wire
have already passed the caps of `limits`; constructors check nothing.

Numbers: a *packet number* counts the datagrams of one channel (sender's boot to one receiver's boot, or to all), starts
at 0 and is never reused. A *message id* counts the messages of one such channel and stays the same in every
retransmission.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple, TypeAlias

Payload: TypeAlias = bytes | bytearray | memoryview


class Feature:
    """Bits of the optional features that a node announces; unknown bits are ignored."""

    ZLIB = 1
    """Accepts messages compressed with zlib (RFC 1950)."""
    REPAIR = 2
    """Requests lost broadcasts with `Nack`, and answers such requests."""
    TIMED = 4
    """Accepts `Sent` and a head's remaining lifetime, timestamps what it sends, and answers a ping to its source."""
    CONFIRM = 8
    """Answers messages that have `MessageFlag.CONFIRM` with `Delivered` once they are safe."""
    COMPACT = 16
    """Accepts compact fragments."""
    LOGS = 32
    """Has topics that are shared logs, and takes part in passing on their items."""
    ZSTD = 64
    """Accepts messages compressed with zstd (RFC 8878)."""
    VERSIONS = 128
    """Keeps versions of a topic's content and accepts differences to them (see `version`)."""
    RELAY = 256
    """Accepts relay datagrams: it can be reached through relays, and may be one."""
    SUBSCRIPTIONS = 512
    """Answers a question for what its programs read, and needs no other messages."""
    THIN = 1024
    """Accepts messages that have `MessageFlag.NUMBERED`, and delivers each number of a boot once."""


class Waiting(NamedTuple):
    """One priority level with a message waiting at the sender; other nodes hold back their less urgent levels."""

    priority: int
    """0 (most urgent) to 15."""
    age_ms: int
    """Age of its oldest message, at most 65,535 ms."""


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """The sender and the boots it hears. Its boot id is in the datagram's long header, authenticated with it."""

    name: str
    """The node's name, 1 to 63 bytes of UTF-8 without space, control character or slash."""
    min_version: int
    max_version: int
    """Supported wire versions, 1 to 7."""
    features: int
    """Bits of `Feature`."""
    interval_ms: int
    """Maximum time until the next one, 1 to 65,535 ms: heartbeats are sparser while traffic proves the link."""
    known_peers: int
    """Peers online at the sender."""
    send_rate: int
    """Wire bytes/s that the sender sends to all nodes, averaged over about 1 s: how busy the channel is."""
    broadcast_number: int
    """The sender's next broadcast packet number; a verified peer accepts no older broadcast packet (replays)."""
    broadcast_messages: int
    """The sender's next broadcast message id: a receiver that misses one requests it with `Nack`."""
    heard: tuple[bytes, ...] = ()
    """First 8 bytes of the boot ids heard recently: a node that finds itself here knows that the link works both
    ways."""
    waiting: tuple[Waiting, ...] = ()
    clock_ms: int | None = None
    """The sender's clock as in `Sent`; None if its version does not include it."""
    heard_clocks: tuple[int, ...] = ()
    """For the first boots of `heard`: the clock of the newest heartbeat heard from each, in units of 256 ms, modulo
    2**24. A boot that finds its own recent clock here knows that this heartbeat is no recording."""


class MessageFlag:
    """Bits that say how a message is to be treated. Plain integers, as in `Feature`: an `IntFlag` costs a microsecond a
    use."""

    RELIABLE = 1
    """Retransmitted until delivered, expired or the peer is lost; otherwise best effort."""
    COMPRESSED = 2
    """The bytes are zlib (RFC 1950), with `ZSTD` zstd; the receiver bounds what they may inflate to."""
    TO_ALL = 4
    """Addressed to every node, whether this copy was broadcast or not."""
    REPAIR = 8
    """A broadcast that can be requested again with `Nack`."""
    CONFIRM = 16
    """The sender waits for a `Delivered`: the receiving program took the message, or the receiver has it on disk.
    Set only to peers that announce `Feature.CONFIRM`."""
    NUMBERED = 32
    """The bytes begin with the number (2) under which the sender's thin links carry the message as well. Set only to
    peers that announce `Feature.THIN`."""
    ZSTD = 64
    """With `COMPRESSED`: the bytes are one zstd frame (RFC 8878) that states its content size."""
    VERSION = 128
    """The bytes begin with the header of `version`. The receiver keeps the version and acknowledges it only once its
    hash is checked. Set only to peers that announce `Feature.VERSIONS`."""


class MessageHead(NamedTuple):
    """Properties of a message, carried by its first fragment (position 0)."""

    size_bytes: int
    """Bytes of the whole message as sent (after compression)."""
    fragments: int
    """Number of fragments, at least 1, none of them empty unless the message is."""
    topic_id: int
    """Number assigned by a `TopicAnnounce` of the same sender boot, 0 to 65,535."""
    priority: int
    """0 (most urgent) to 15."""
    flags: int
    """Bits of `MessageFlag`."""
    age_ms: int = 0
    """Time since the message was accepted for sending, when this copy was sent; up to 2**32-1 ms (49 days)."""
    life_ms: int | None = None
    """Remaining lifetime when this copy was sent, at least 1; None: no deadline, or not included."""


class Fragment(NamedTuple):
    """A part of a message. A NamedTuple because it is the one frame built tens of thousands of times a second."""

    message_id: int
    """32 bits, counts the messages of this channel (or the broadcast channel, see `broadcast_id`)."""
    position: int
    """0 to fragments - 1."""
    payload: Payload
    """The bytes; a decoded fragment's is a view into its datagram."""
    head: MessageHead | None = None
    """Present exactly if position is 0."""
    ack_now: bool = False
    """Acknowledge at once instead of batching (urgent messages, the last fragments in flight)."""
    broadcast_id: bool = False
    """In a unicast datagram: `message_id` counts in the sender's broadcast channel (repair, or per-peer copy of it)."""


class Ack(NamedTuple):
    """The packets of the reverse channel that arrived."""

    largest: int
    """Largest packet number received (48 bits)."""
    received: int
    """256-bit bitmap: bit i set means packet `largest - 1 - i` arrived. Bits below packet 0 are clear."""
    delay_us: int
    """From the arrival of `largest` to this acknowledgment's sending, at most 2**24-1 us."""
    receive_rate: int
    """Wire bytes/s arriving from this peer, averaged over about 1 s (0: none, or not known yet)."""
    waiting: tuple[Waiting, ...] = ()


@dataclass(frozen=True, slots=True)
class Delivered:
    """These messages are complete and delivered at the receiver."""

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
    """The receiver no longer has the fragments it acknowledged (or the topic's name): restart the message."""


@dataclass(frozen=True, slots=True)
class Refused:
    """The receiver does not accept this message."""

    message_id: int
    reason: RefuseReason
    broadcast_id: bool = False


@dataclass(frozen=True, slots=True)
class Cancel:
    """The sender gives these messages up (expired, replaced by a newer one): discard their fragments."""

    message_ids: tuple[int, ...]
    broadcast_ids: bool = False


@dataclass(frozen=True, slots=True)
class Nack:
    """Missing fragments of one broadcast message; no ranges: all of it."""

    message_id: int
    ranges: tuple[tuple[int, int], ...] = ()
    """(first position, count >= 1) each."""


@dataclass(frozen=True, slots=True)
class TopicAnnounce:
    """Assigns a number to a topic, for the life of the sender's boot."""

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
    """When this datagram was sent, by the sender's own clock: only differences are meaningful."""

    clock_ms: int
    """Milliseconds, modulo 2**32."""


@dataclass(frozen=True, slots=True)
class Bye:
    """The sender shuts down; peers report it offline at once."""

    reason: str = ""


Frame: TypeAlias = (
    Heartbeat | Fragment | Ack | Delivered | Refused | Cancel | Nack | TopicAnnounce | Ping | Pong | Bye | Sent
)
