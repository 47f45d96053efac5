"""Network conditions for the autonomy: rates, round trip, loss and queues per peer, and counters of the node."""

from dataclasses import dataclass

from udp_mesh.core.link_trend import Trend
from udp_mesh.core.settings import Address


@dataclass(frozen=True, slots=True)
class QueueConditions:
    """The messages waiting for one peer on one priority level, and the level's starvation."""

    priority: int
    messages: int
    bytes: int
    oldest_s: float
    """Age of the oldest message."""
    starved_s: float
    """Time in which this level waited while only more urgent ones were sent, since the node started."""
    held_s: float
    """Time in which this level was held back for other robots' more urgent messages."""
    drained_in_s: float | None = None
    """Time until what waits now on this level, and before it on more urgent ones, is sent at the link's estimated
    capacity. Messages under way count whole, so it is an upper bound. None if the capacity is unknown, or the peer is
    offline."""


@dataclass(frozen=True, slots=True)
class UnverifiedNode:
    """A node that is heard but does not hear us. It is no peer, because nothing would reach it."""

    name: str
    address: Address
    link: str
    met_at: float
    last_heard: float


@dataclass(frozen=True, slots=True)
class PeerConditions:
    """One peer. Rates are over the last second; times in seconds; None if not measured yet."""

    name: str
    online: bool
    legacy: bool
    address: Address | None
    link: str | None
    online_since: float | None
    last_heard: float | None
    round_trip_s: float | None
    least_round_trip_s: float | None
    loss: float
    """Fraction of packets to the peer that are lost, 0 to 1, smoothed."""
    sent_bits_per_s: float
    """Wire bits of messages sent to the peer, with IP and UDP headers, without acknowledgments and control frames."""
    delivered_bits_per_s: float
    """Payload bits the peer acknowledged."""
    received_bits_per_s: float
    """Wire bits received from the peer."""
    arrived_bits_per_s: float | None
    """Wire bits received by the peer from us, as reported in its acknowledgments."""
    peer_sends_bits_per_s: float | None
    """Wire bits that the peer reports sending to all nodes."""
    capacity_bits_per_s: float | None
    """The link's estimated capacity for payload, if enough was sent to measure it."""
    window_packets: float
    in_flight_packets: int
    retransmitted_packets: int
    queues: tuple[QueueConditions, ...]
    outbox_messages: int
    outbox_bytes: int
    one_way: bool
    """We hear the peer, but its heartbeats show that it does not hear us; if that lasts, it goes offline."""
    unanswered_for_s: float | None
    """How long nothing sent to the peer was acknowledged, even if it is heard; None if nothing awaits an
    acknowledgment."""
    sent_bytes: int = 0
    """What `sent_bits_per_s` is the rate of, since the peer was first sent to; the next two likewise."""
    delivered_bytes: int = 0
    received_bytes: int = 0
    """Since its current boot was heard, of authentic datagrams to this node alone, each counted once."""
    saved_messages: int = 0
    """Messages not sent because its programs do not want them, since the node's start."""
    saved_bytes: int = 0
    via: tuple[str, ...] = ()
    """The relays on the way to it, the nearest first, as far as known; empty if it is reached directly."""
    available_bits_per_s: tuple[float, ...] | None = None
    """By priority: what its messages would get now, the capacity less what more urgent levels take. None if the
    capacity is unknown, or the peer is offline."""
    trend: Trend | None = None
    """Whether the link gets better or worse. None if too little was sent lately, or the peer is offline."""
    path_mtu_bytes: int | None = None
    """The largest IP packet that is sent to it: the MTU of the link, or what its path was found to carry. None if there
    is no path, or the peer speaks the legacy format."""


@dataclass(slots=True)
class Counters:
    """Totals since the node's start. The node keeps one instance; a snapshot holds a copy."""

    datagrams_sent: int = 0
    bytes_sent: int = 0
    datagrams_received: int = 0
    bytes_received: int = 0
    heartbeats_sent: int = 0
    acknowledgements_sent: int = 0
    fragments_sent: int = 0
    fragments_retransmitted: int = 0
    fragments_received: int = 0
    duplicates_received: int = 0
    messages_sent: int = 0
    messages_delivered: int = 0
    messages_expired: int = 0
    messages_peer_lost: int = 0
    messages_received: int = 0
    dropped_malformed: int = 0
    dropped_unauthenticated: int = 0
    dropped_replayed: int = 0
    dropped_unproven: int = 0
    dropped_stale: int = 0
    """Authentic and never seen before, but too old: replayed, or delayed by more than `ACCEPT_AGE_S`."""
    dropped_over_limit: int = 0
    events_dropped: int = 0
    repairs_asked: int = 0
    repairs_sent: int = 0

    @property
    def dropped_unverified(self) -> int:
        """Datagrams of which nothing was believed: forged, damaged, replayed or foreign."""
        return (
            self.dropped_malformed
            + self.dropped_unauthenticated
            + self.dropped_replayed
            + self.dropped_unproven
            + self.dropped_stale
        )


@dataclass(frozen=True, slots=True)
class Conditions:
    """A snapshot at `now`."""

    now: float
    name: str
    peers: tuple[PeerConditions, ...]
    counters: Counters
    sent_bits_per_s: float
    """Wire bits sent by this node to all nodes."""
    heard_bits_per_s: float
    """Wire bits that this node and its online peers send together, as reported: how busy the channel is."""
    partial_bytes: int
    queued_bytes: int
    repair_bytes: int
    strangers: tuple[UnverifiedNode, ...]
