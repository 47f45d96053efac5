"""The events of a node, in the order they happened: peers come and go, messages arrive, sent messages end.

Every reliable message ends, per destination, in exactly one of `MessageDelivered`, `MessageExpired`, `MessagePeerLost`.
"""

from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, NewType

from udp_mesh.core.settings import Address

MessageId = NewType("MessageId", int)
"""Identifies one `Endpoint.send`, unique within a node's life; its outcomes carry it once per destination."""


class RejectReason(Enum):
    """Why `Endpoint.send` did not accept a message."""

    UNKNOWN_TOPIC = "unknown topic"
    UNKNOWN_PEER = "unknown peer"
    TOO_LARGE = "too large"
    QUEUE_FULL = "queue full"
    LOG_FULL = "log full"
    CLOSED = "closed"


@dataclass(frozen=True, slots=True)
class Rejected:
    """`Endpoint.send` refused the message; nothing of it is kept and no outcome follows."""

    reason: RejectReason
    detail: str


class ExpiryReason(Enum):
    """Why an accepted message was given up."""

    DEADLINE = "deadline"
    SUPERSEDED = "superseded by a newer one"
    REFUSED = "refused by the receiver"
    CLOSED = "node closed"
    OUTBOX_FULL = "outbox full"
    LOG_FULL = "log full"
    TOO_OLD = "older than the log keeps"
    TOO_LARGE = "too large for a thin link"
    DISK = "disk error"
    NOT_WANTED = "not wanted"
    """No program there reads the topic."""


@dataclass(frozen=True, slots=True)
class PeerOnline:
    """A peer was verified for the first time, or after having been offline."""

    peer: str
    address: Address
    link: str


@dataclass(frozen=True, slots=True)
class PeerOffline:
    """Nothing came from the peer for `offline_s`, or it said goodbye (`left`)."""

    peer: str
    left: bool


@dataclass(frozen=True, slots=True)
class PeerRestarted:
    """The peer restarted: whatever it had not finished receiving is sent again."""

    peer: str


@dataclass(frozen=True, slots=True)
class PeerAddressChanged:
    """The peer, without having restarted, is now reached at another address."""

    peer: str
    old: Address
    new: Address
    link: str


@dataclass(frozen=True, slots=True)
class PeerRouteChanged:
    """A peer behind relays is now reached through the neighbor `via`, over `hops` links."""

    peer: str
    via: str
    hops: int


@dataclass(frozen=True, slots=True)
class NameConflict:
    """Two running nodes use one name (ours if `own`). Messages go to the one that appeared last."""

    name: str
    first: Address
    second: Address
    own: bool


@dataclass(frozen=True, slots=True)
class KeyMismatch:
    """Datagrams from this address are sealed with an unknown key (at most once a minute per address, and a few a minute
    in total)."""

    address: Address
    link: str
    more: int = 0
    """Such datagrams from other addresses that no event has reported since the last one."""


@dataclass(frozen=True, slots=True)
class Incompatible:
    """A peer speaks only versions that this node does not (`versions` is its lowest and highest)."""

    peer: str
    address: Address
    versions: tuple[int, int]


class Receipt(NamedTuple):
    """Identifies a received message whose sender waits until it is confirmed."""

    boot_id: bytes
    message_id: int


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """A complete message. `payload` is as passed to the sender's `send`. One with a receipt is delivered only once
    `Endpoint.confirm` was called for it."""

    source: str
    topic: str
    type_name: str
    payload: bytes
    priority: int
    broadcast: bool
    receipt: Receipt | None = None
    number: int | None = None
    """Its number in the source's log, if the topic is a log: a program that keeps it sees each item once."""


@dataclass(frozen=True, slots=True)
class MessageDelivered:
    """The destination's node has the complete message. If the topic's outbox is on disk, the message is safe there: the
    receiving program took it, or the node has it on disk. `latency_s` is from `send` to the acknowledgment."""

    message_id: MessageId
    peer: str
    topic: str
    latency_s: float


@dataclass(frozen=True, slots=True)
class MessageExpired:
    """The message was given up for this destination before it was delivered."""

    message_id: MessageId
    peer: str
    topic: str
    reason: ExpiryReason


@dataclass(frozen=True, slots=True)
class MessagePeerLost:
    """The destination stayed silent for `peer_lost_s` and no outbox keeps the message."""

    message_id: MessageId
    peer: str
    topic: str


@dataclass(frozen=True, slots=True)
class LogItemHeld:
    """Another node now has an item of this node's log on disk, to pass it on. A reader's is a `MessageDelivered`."""

    message_id: MessageId
    holder: str
    topic: str
    number: int


@dataclass(frozen=True, slots=True)
class LogItemDropped:
    """An item was removed from this node's log before all of its readers were known to have it."""

    topic: str
    source: str
    number: int
    reason: ExpiryReason


@dataclass(frozen=True, slots=True)
class TopicStarved:
    """Messages of the topic have waited this long because more urgent ones are always sent first."""

    peer: str
    topic: str
    waited_s: float


@dataclass(frozen=True, slots=True)
class PathNarrowed:
    """Small datagrams reach the peer, full ones do not: it now gets fragments of `fragment_bytes` in packets of
    `mtu`."""

    peer: str
    mtu: int
    fragment_bytes: int


@dataclass(frozen=True, slots=True)
class ThinPeerHeard:
    """A node is heard on a thin link, and hears this node."""

    peer: str
    link: str


@dataclass(frozen=True, slots=True)
class ThinPeerSilent:
    """A node is no longer heard on thin links."""

    peer: str


@dataclass(frozen=True, slots=True)
class ThinLinkRejecting:
    """So many frames of a thin link could not be authenticated that it accepts nothing for the rest of an hour."""

    link: str
    failures: int


Event = (
    PeerOnline
    | PeerOffline
    | PeerRestarted
    | PeerAddressChanged
    | PeerRouteChanged
    | NameConflict
    | KeyMismatch
    | Incompatible
    | MessageReceived
    | MessageDelivered
    | MessageExpired
    | MessagePeerLost
    | LogItemHeld
    | LogItemDropped
    | TopicStarved
    | PathNarrowed
    | ThinPeerHeard
    | ThinPeerSilent
    | ThinLinkRejecting
)
