"""The settings of a node: topics, neighbors, rates and limits, as validated values.

A `Settings` is passed to `Endpoint` at start and, if changed at run time, to `Endpoint.apply`. It is immutable;
`dataclasses.replace` creates the next one.
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from udp_mesh.core.setting_checks import check_fields, check_name, written
from udp_mesh.core.thin.settings import ThinSettings, check_thin
from udp_mesh.crypto import Key
from udp_mesh.wire.limits import (
    MAX_LOG_TOPIC_BYTES,
    MAX_NAME_BYTES,
    MAX_RELAY_HOPS,
    MAX_TOPIC_BYTES,
    PRIORITY_LEVELS,
)

Address = tuple[str, int]
"""IPv4 or IPv6 host and UDP port."""

RELAY_LINK = "~relay"
"""The link on which nodes behind relays are reached; addresses on it are boot ids (see `core.relaying`)."""

DEFAULT_PORT = 8700
"""UDP port of the legacy system, kept so that one firewall rule serves both."""


class Outbox(Enum):
    """What a topic keeps for an offline peer."""

    NONE = "none"
    LAST = "last"
    ALL = "all"


class LinkKind(Enum):
    """Whether a link reaches all nodes with one datagram, or only configured neighbors individually."""

    BROADCAST = "broadcast"
    NEIGHBOURS = "neighbours"


@dataclass(frozen=True, slots=True)
class LinkInfo:
    """One network attachment of this node, as described by the kernel (or the simulator).

    `mtu` is that of IP packets, in bytes. A link of kind `NEIGHBOURS` needs no `broadcast` address.
    """

    name: str
    kind: LinkKind
    address: Address
    broadcast: Address | None = None
    mtu: int = 1500

    def __post_init__(self) -> None:
        if self.kind is LinkKind.BROADCAST and self.broadcast is None:
            raise ValueError(f"link {self.name}: a broadcast link needs a broadcast address")
        if self.mtu < MIN_LINK_MTU:
            raise ValueError(f"link {self.name}: expected an MTU of at least {MIN_LINK_MTU} bytes, found {self.mtu}")


MIN_LINK_MTU = 200
"""Smallest IP MTU in bytes that leaves room for headers and a useful payload."""


MAX_COPIES = 64
"""More carriers of one item than any team needs."""


@dataclass(frozen=True, slots=True)
class Log:
    """A topic whose items are numbered, kept and passed on by every node that declares it, until its readers have them.

    `readers` are the nodes whose programs get the items (empty: all nodes with the topic). Each node keeps the newest
    items up to `max_items`, `max_bytes` and `max_age_s` (None: no limit), counted from when it stored them. `copies` is
    how many nodes that reach each other carry an item, besides its source and readers (0: none).
    """

    readers: tuple[str, ...] = ()
    max_items: int = 10_000
    max_bytes: int = 256 << 20
    max_age_s: float | None = None
    copies: int = 3

    def __post_init__(self) -> None:
        check_fields(self, "log.")
        for name in ("max_items", "max_bytes"):
            if getattr(self, name) < 1:
                raise ValueError(f"log.{name}: expected at least 1, found {getattr(self, name)}")
        if not 0 <= self.copies <= MAX_COPIES:
            raise ValueError(f"log.copies: expected 0 to {MAX_COPIES}, found {self.copies}")
        if self.max_age_s is not None and self.max_age_s <= 0:
            raise ValueError(f"log.max_age_s: expected a positive time, found {self.max_age_s}")


@dataclass(frozen=True, slots=True)
class Topic:
    """How the messages of one topic are sent.

    `priority` 0 is the most urgent. `keep_last` limits how many messages of the topic wait for one destination: a newer
    one replaces the oldest (None: no limit). `deadline_s` is a message's lifetime from its `send`. `destinations` lists
    the peers that get a message sent without a destination (empty: all). `repair` lets receivers request a lost
    broadcast again. `delta` sends a message as the difference to the last one that its receiver has, if both have at
    most `delta_bytes`. With `always`, it is also sent to peers whose programs do not read it. With `thin`, the thin
    links in `links` (empty: all) carry it too, at most once in `thin_period_s`, the newest message only.
    """

    name: str
    priority: int = 8
    reliable: bool = True
    keep_last: int | None = None
    deadline_s: float | None = None
    rate_limit_bytes_per_s: int | None = None
    compression: bool = False
    destinations: tuple[str, ...] = ()
    outbox: Outbox = Outbox.NONE
    outbox_bytes: int = 16 << 20
    outbox_on_disk: bool = False
    repair: bool = False
    log: Log | None = None
    delta: bool = False
    delta_bytes: int = 16 << 20
    always: bool = False
    thin: bool = False
    links: tuple[str, ...] = ()
    thin_period_s: float | None = None

    @property
    def keeps_on_disk(self) -> bool:
        """Whether its outbox is on disk; then its receivers keep messages on disk too, until a program takes them."""
        return self.outbox_on_disk and self.outbox is not Outbox.NONE

    def __post_init__(self) -> None:
        check_name(self.name, "topic", MAX_TOPIC_BYTES)
        check_fields(self, f"topic {self.name}: ")
        if not 0 <= self.priority < PRIORITY_LEVELS:
            raise ValueError(f"topic {self.name}: expected a priority of 0 to 15, found {self.priority}")
        if self.keep_last is not None and self.keep_last < 1:
            raise ValueError(f"topic {self.name}: expected keep_last of at least 1, found {self.keep_last}")
        if self.deadline_s is not None and self.deadline_s <= 0:
            raise ValueError(f"topic {self.name}: expected a positive deadline_s, found {self.deadline_s}")
        if self.rate_limit_bytes_per_s is not None and self.rate_limit_bytes_per_s <= 0:
            raise ValueError(f"topic {self.name}: expected a positive rate limit, found {self.rate_limit_bytes_per_s}")
        if self.outbox_bytes < 0:
            raise ValueError(f"topic {self.name}: expected outbox_bytes of at least 0, found {self.outbox_bytes}")
        if self.delta_bytes < 1:
            raise ValueError(f"topic {self.name}: expected delta_bytes of at least 1, found {self.delta_bytes}")
        if self.log is not None:
            self._check_log()
        if self.thin and (self.compression or self.delta or self.log is not None):
            raise ValueError(f"topic {self.name}: expected no compression, delta or log for a thin topic, found one")
        if self.thin_period_s is not None and self.thin_period_s <= 0:
            raise ValueError(f"topic {self.name}: expected a positive thin_period_s, found {self.thin_period_s}")

    def _check_log(self) -> None:
        """Raises ValueError for what contradicts a log: its items wait in it, for all its readers."""
        if len(self.name.encode()) > MAX_LOG_TOPIC_BYTES:
            raise ValueError(f"topic {self.name}: expected at most {MAX_LOG_TOPIC_BYTES} bytes for the name of a log")
        if not self.reliable:
            raise ValueError(f"topic {self.name}: expected reliable = true for a log, found false")
        for name, unset in (
            ("keep_last", None),
            ("deadline_s", None),
            ("destinations", ()),
            ("outbox", Outbox.NONE),
            ("repair", False),
            ("delta", False),
        ):
            if getattr(self, name) != unset:
                raise ValueError(
                    f"topic {self.name}: expected no {name} for a log, found {written(getattr(self, name))}"
                )


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A configured peer address, used instead of or in addition to broadcast.

    `link` selects the link (None: every link of kind `NEIGHBOURS`, or the first link if there is none). A `legacy`
    neighbor speaks the legacy format; its `name` is then required, because names in that format are not authenticated.
    """

    address: Address
    name: str | None = None
    link: str | None = None
    legacy: bool = False

    def __post_init__(self) -> None:
        check_fields(self, "neighbor ")
        if self.legacy and self.name is None:
            raise ValueError(f"neighbor {self.address[0]}: legacy requires a name")


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """Whether this node passes datagrams on between others, and how far its own may travel.

    `all`: for every node; otherwise only datagrams to or from the nodes in `names`. `hops` limits the links of a
    relayed path (1: no relays, neither for others nor for itself). `keys` are those of hops (none: derived from the
    fleet keys); with them, relays need not hold a fleet key.
    """

    names: tuple[str, ...] = ()
    all: bool = False
    hops: int = 4
    keys: tuple[Key, ...] = ()

    @property
    def enabled(self) -> bool:
        """Whether this node is a relay."""
        return self.hops > 1 and (self.all or bool(self.names))

    def __post_init__(self) -> None:
        check_fields(self, "relay ")
        for name in self.names:
            check_name(name, "relay", MAX_NAME_BYTES)
        if not 1 <= self.hops <= MAX_RELAY_HOPS:
            raise ValueError(f"relay_hops: expected 1 to {MAX_RELAY_HOPS}, found {self.hops}")
        if (self.all or self.names) and self.hops == 1:
            raise ValueError("relay_hops: expected at least 2 beside relay, found 1")
        if len(self.keys) > 2:
            raise ValueError(f"relay keys: expected at most two live keys, found {len(self.keys)}")


@dataclass(frozen=True, slots=True)
class Rates:
    """Times and thresholds of the protocol, in seconds, priorities and packets."""

    heartbeat_s: float = 1.0
    """Heartbeat interval of an idle node (that of the legacy system)."""
    heartbeat_sparse_s: float = 3.0
    """Heartbeat interval while traffic already proves every link; less than a third of `offline_s`."""
    heartbeats_heard_per_s: float = 30.0
    """In larger teams every node sends heartbeats less often, so that the cost of discovery stays constant."""
    offline_s: float = 10.0
    """Silence after which a peer is reported offline (that of the legacy system)."""
    peer_lost_s: float = 60.0
    """Silence after which reliable messages without an outbox end as peer lost; longer than driving through a
    tunnel."""
    urgent_priority: int = 3
    """The last level that counts as urgent: not paced, acknowledged at once, sent twice on a lossy path."""
    urgent_excess_packets: int = 4
    """How far urgent packets may exceed the window."""
    twice_loss: float = 0.005
    """Loss rate from which small urgent messages are sent twice: with one in a hundred lost, the slowest percent is
    made of lost ones. A single loss among many packets stays below."""
    twice_gap_s: float = 0.003
    """Between the two transmissions: longer than most loss bursts of a radio, short against a deadline."""
    ack_every_packets: int = 10
    """Packets per acknowledgment under bulk: with 8 to 16, acknowledgments cost under 5 % of a half-duplex
    channel."""
    ack_delay_s: float = 0.008
    """Maximum delay of an acknowledgment; under bulk the sender requests most of them at once (see `ack_spacing`)."""
    pace_quantum_s: float = 0.003
    """Packets worth this much time are sent together; less costs CPU per wake-up, more costs latency."""
    pack_s: float = 0.003
    """How long a small message that is not urgent waits for others to share its datagram, in a stream of them."""
    broadcast_packets_per_s: float = 400.0
    """Rate limit of less urgent broadcasts: they are not acknowledged, so no window limits them."""
    starved_s: float = 5.0
    """How long a level waits while others are sent before its topic is reported as starved."""
    yield_after_s: float = 0.03
    """How much longer than three round trips an urgent message waits here before other nodes are asked to hold back
    less urgent traffic."""
    yield_hold_s: float = 0.1
    """How long less urgent traffic is held back after one such request."""
    yield_share: float = 0.8
    """Maximum fraction of time for which a level may be held back, so that none starves."""

    def __post_init__(self) -> None:
        check_fields(self, "rates.")
        times = (
            "heartbeat_s",
            "heartbeat_sparse_s",
            "offline_s",
            "peer_lost_s",
            "ack_delay_s",
            "pace_quantum_s",
            "pack_s",
        )
        for name in times:
            if getattr(self, name) <= 0:
                raise ValueError(f"rates.{name}: expected a positive time, found {getattr(self, name)}")
        if not 0 <= self.yield_share < 1:
            raise ValueError(f"rates.yield_share: expected 0 to below 1, found {self.yield_share}")


@dataclass(frozen=True, slots=True)
class Limits:
    """Memory limits, and the attack or overload that each one bounds."""

    message_bytes: int = 64 << 20
    """One message, sent or received, also after decompression: a peer announcing a huge one."""
    peers: int = 1024
    """Sessions: a key holder inventing names."""
    strangers: int = 256
    """Unverified or undecryptable senders: a flood of invented senders."""
    partial_bytes_per_peer: int = 128 << 20
    """Bytes of unfinished messages of one peer: messages started and never finished."""
    partial_bytes: int = 256 << 20
    """The same for all peers, including their topics' names: a key holder inventing names."""
    partials_per_peer: int = 4096
    """Unfinished messages of one peer: as above, with tiny fragments."""
    finished_ranges_per_peer: int = 4096
    """Ranges of remembered finished message numbers: numbers chosen with gaps."""
    queue_bytes_per_peer: int = 256 << 20
    """Bytes pending for one peer: an application faster than the link."""
    queue_messages_per_peer: int = 65536
    """Messages pending for one peer: as above, with tiny messages."""
    queue_bytes: int = 512 << 20
    """The same for all peers and outboxes, a message to several counted once: applications sending to many names."""
    repair_bytes: int = 4 << 20
    """Broadcasts kept for repair: an application that broadcasts without end."""
    events: int = 65536
    """Events not fetched: a driver that stopped reading. The oldest received messages are then dropped and counted."""
    topics_per_peer: int = 1024
    """Topic names a peer may announce: a key holder inventing names."""
    version_bytes_per_peer: int = 64 << 20
    """Versions of one peer's messages held as bases of differences: as for `partial_bytes_per_peer`."""
    version_bytes: int = 128 << 20
    """The same for all peers, and as much for the versions sent."""

    def __post_init__(self) -> None:
        check_fields(self, "limits.")
        for name in self.__slots__:
            if getattr(self, name) < 1:
                raise ValueError(f"limits.{name}: expected at least 1, found {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class Settings:
    """The complete settings of a node. `keys` holds at most two: the first seals, both open. To run without keys, set
    `unkeyed` explicitly.

    `window` is "adaptive" or a fixed number of packets in flight per peer (3 in the legacy udp_mesh). `fragment_bytes`
    is the maximum payload of one datagram; a link's MTU may lower it. `undeclared` applies to topics that `topics` does
    not list (None: they are refused). With `confirms`, the driver calls `Endpoint.confirm` for each received message
    that has a receipt, once the message is safe. With `selective`, it announces what its programs read to peers that
    ask, and sends peers only what theirs read.
    """

    name: str
    port: int = DEFAULT_PORT
    keys: tuple[Key, ...] = ()
    unkeyed: bool = False
    topics: tuple[Topic, ...] = ()
    undeclared: Topic | None = None
    neighbours: tuple[Neighbour, ...] = ()
    window: Literal["adaptive"] | int = "adaptive"
    fragment_bytes: int = 1400
    confirms: bool = False
    selective: bool = False
    relay: RelaySettings = field(default_factory=RelaySettings)
    thin: ThinSettings = field(default_factory=ThinSettings)
    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        check_name(self.name, "name", MAX_NAME_BYTES)
        if "/" in self.name:
            raise ValueError(f"name {self.name!r}: expected no slash (names are parts of topic names)")
        check_fields(self)
        if not 0 < self.port <= 65535:
            raise ValueError(f"port: expected 1 to 65535, found {self.port}")
        if not self.keys and not self.unkeyed:
            raise ValueError("keys: expected a fleet key or an explicit unkeyed=True, found neither")
        if self.keys and self.unkeyed:
            raise ValueError("keys: expected either keys or unkeyed=True, found both")
        if len(self.keys) > 2:
            raise ValueError(f"keys: expected at most two live keys, found {len(self.keys)}")
        if self.window != "adaptive" and not 1 <= self.window <= 4096:
            raise ValueError(f"window: expected 'adaptive' or 1 to 4096 packets, found {self.window}")
        if not 64 <= self.fragment_bytes <= 8192:
            raise ValueError(f"fragment_bytes: expected 64 to 8192, found {self.fragment_bytes}")
        names = [topic.name for topic in self.topics]
        if len(set(names)) != len(names):
            raise ValueError(f"topics: {next(n for n in names if names.count(n) > 1)!r} is listed twice")
        check_thin(self.name, [topic.name for topic in self.topics if topic.thin], self.thin.links)
