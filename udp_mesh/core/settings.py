"""What an operator chooses about a node: topics, peers, rates and limits, all values, checked when made.

A `Settings` is handed to `Node` at its start and, changed at run time, to `Node.apply`; it never changes in place
(`dataclasses.replace` makes the next one).
"""

from dataclasses import dataclass, field
from enum import Enum
from typing import Literal

from udp_mesh.crypto import Key
from udp_mesh.wire.limits import MAX_NAME_BYTES, MAX_TOPIC_BYTES, MAX_TYPE_BYTES, PRIORITY_LEVELS

Address = tuple[str, int]
"""IPv4 or IPv6 host and UDP port."""

DEFAULT_PORT = 8700
"""UDP port of the fielded system, kept so that one firewall rule serves both."""


def is_name(name: str, limit_bytes: int) -> bool:
    """Whether the wire accepts this as the name of a node or a topic."""
    # half a surrogate pair is not printable, so that what is encoded here can be
    return name.isprintable() and not any(map(str.isspace, name)) and 1 <= len(name.encode()) <= limit_bytes


def is_type_name(name: str) -> bool:
    """Whether the wire accepts this as the name of a topic's type, which may be empty."""
    return name.isprintable() and len(name.encode()) <= MAX_TYPE_BYTES


def _check_name(name: str, what: str, limit_bytes: int) -> None:
    """Raises ValueError unless this `is_name`."""
    if not 0 < len(name.encode()) <= limit_bytes:
        raise ValueError(f"{what} {name!r}: expected 1 to {limit_bytes} bytes")
    if not is_name(name, limit_bytes):
        raise ValueError(f"{what} {name!r}: expected no white space and no control characters")


class Outbox(Enum):
    """What a topic keeps for a peer that is offline."""

    NONE = "none"
    LAST = "last"
    ALL = "all"


class LinkKind(Enum):
    """Whether a link reaches everyone with one datagram, or only configured neighbours one by one."""

    BROADCAST = "broadcast"
    NEIGHBOURS = "neighbours"


@dataclass(frozen=True, slots=True)
class LinkInfo:
    """One network attachment of this node, as the kernel (or the simulator) describes it.

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
"""Smallest IP MTU in bytes that leaves room for headers and a useful piece of payload."""


@dataclass(frozen=True, slots=True)
class Topic:
    """How messages of one name travel.

    `priority` 0 is the most urgent. `keep_last` bounds how many messages of the topic wait for one destination: a newer
    one replaces the oldest (None: no such bound). `deadline_s` is a message's life from its `send`. `destinations`
    names the peers a message without a destination goes to (empty: all). `repair` lets receivers ask again for a lost
    broadcast.
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

    def __post_init__(self) -> None:
        _check_name(self.name, "topic", MAX_TOPIC_BYTES)
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


@dataclass(frozen=True, slots=True)
class Neighbour:
    """A peer reached by configuration instead of, or besides, broadcast.

    `link` picks the link (None: every link of kind `NEIGHBOURS`, or the first link when there is none). A `legacy`
    neighbour speaks the fielded format; its `name` is then required, since names announced in that format are not
    authenticated and are not believed.
    """

    address: Address
    name: str | None = None
    link: str | None = None
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.legacy and self.name is None:
            raise ValueError(f"neighbour {self.address[0]}: a legacy neighbour needs a name")


@dataclass(frozen=True, slots=True)
class Rates:
    """Times and thresholds of the protocol, in seconds, priorities and packets."""

    heartbeat_s: float = 1.0
    """Between two heartbeats of an idle node (the fielded system's period)."""
    heartbeat_sparse_s: float = 3.0
    """Between two heartbeats where traffic already proves every link; under a third of `offline_s`."""
    heartbeats_heard_per_s: float = 30.0
    """In teams so large that more would be heard, everyone's heartbeats grow sparser: discovery then costs a
    constant."""
    offline_s: float = 10.0
    """Silence after which a peer is reported offline (the fielded system's)."""
    peer_lost_s: float = 60.0
    """Silence after which reliable messages that no outbox keeps end as peer lost; longer than a tunnel's shadow."""
    urgent_priority: int = 3
    """The last level that counts as urgent: it bypasses pacing, is acknowledged at once, may be sent twice."""
    urgent_excess_packets: int = 4
    """How far urgent packets may exceed the window."""
    twice_loss: float = 0.005
    """Measured loss from which small urgent messages are sent twice: where one in a hundred is lost, the slowest one in
    a hundred is a lost one. A single loss of many packets is less."""
    twice_gap_s: float = 0.003
    """Between the two sendings: longer than most bursts at a radio, short against a deadline."""
    ack_every_packets: int = 10
    """Packets per acknowledgement under bulk: at 8 to 16 acknowledgements cost under 5 % of a half-duplex channel."""
    ack_delay_s: float = 0.008
    """Longest an acknowledgement waits; under bulk the sender asks for most of them at once (see `packets_allowed`)."""
    pace_quantum_s: float = 0.003
    """Packets of this much time leave together; less costs CPU per wake-up, more costs latency."""
    broadcast_packets_per_s: float = 400.0
    """Less urgent broadcasts leave no faster: nothing acknowledges them, so no window can hold them back."""
    starved_s: float = 5.0
    """How long a level waits while others are sent before its topic is reported as starved."""
    yield_after_s: float = 0.03
    """How much longer than three round trips an urgent message waits here before others are asked to hold back their
    less urgent traffic."""
    yield_hold_s: float = 0.1
    """How long less urgent traffic is held back for others after one such report."""
    yield_share: float = 0.8
    """The largest share of time a level may be held back for others, so that none starves."""

    def __post_init__(self) -> None:
        for name in ("heartbeat_s", "heartbeat_sparse_s", "offline_s", "peer_lost_s", "ack_delay_s", "pace_quantum_s"):
            if getattr(self, name) <= 0:
                raise ValueError(f"rates.{name}: expected a positive time, found {getattr(self, name)}")
        if not 0 <= self.yield_share < 1:
            raise ValueError(f"rates.yield_share: expected 0 to below 1, found {self.yield_share}")


@dataclass(frozen=True, slots=True)
class Limits:
    """The most memory each part may hold, and the attack or overload each cap bounds."""

    message_bytes: int = 64 << 20
    """One message, sent or received (also the most a compressed one may grow to): a peer announcing a huge one."""
    peers: int = 1024
    """Sessions: a key holder inventing names."""
    strangers: int = 256
    """Senders seen but not yet proven fresh, or undecryptable: a flood of invented senders."""
    partial_bytes_per_peer: int = 128 << 20
    """Bytes of unfinished messages of one peer: messages begun and never finished."""
    partial_bytes: int = 256 << 20
    """The same of all peers, and their topics' names: a key holder inventing names."""
    partials_per_peer: int = 4096
    """Unfinished messages of one peer: as above, with tiny fragments."""
    finished_ranges_per_peer: int = 4096
    """Ranges of remembered finished message numbers: numbers chosen with gaps."""
    queue_bytes_per_peer: int = 256 << 20
    """Bytes accepted for one peer and not yet ended: an application faster than the link."""
    queue_messages_per_peer: int = 65536
    """Messages accepted for one peer and not yet ended: as above, with tiny messages."""
    repair_bytes: int = 4 << 20
    """Broadcasts kept for repair: an application that broadcasts without end."""
    events: int = 65536
    """Events not fetched: a driver that stopped reading. The oldest best-effort messages are then dropped and
    counted."""
    topics_per_peer: int = 1024
    """Topic names a peer may announce: a key holder inventing names."""

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if getattr(self, name) < 1:
                raise ValueError(f"limits.{name}: expected at least 1, found {getattr(self, name)}")


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything a node is told. `keys` holds at most two: the first seals, both open. Without keys the node runs
    unkeyed, which `unkeyed` must say explicitly.

    `window` is "adaptive" or a fixed number of packets in flight per peer (the paper's is 3). `fragment_bytes` is the
    payload of one datagram at most; a link's MTU may lower it. `undeclared` is how topics that `topics` does not list
    travel (None: they are refused).
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
    rates: Rates = field(default_factory=Rates)
    limits: Limits = field(default_factory=Limits)

    def __post_init__(self) -> None:
        _check_name(self.name, "name", MAX_NAME_BYTES)
        if "/" in self.name:
            raise ValueError(f"name {self.name!r}: expected no slash (names are parts of topic names)")
        if not self.keys and not self.unkeyed:
            raise ValueError("keys: expected a fleet key, or unkeyed=True said explicitly; found neither")
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
