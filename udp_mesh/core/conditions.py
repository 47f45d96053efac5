"""How the network is, for the autonomy to decide by: per peer rates, round trip, loss, queues; counters of the node."""

from dataclasses import dataclass

from udp_mesh.core.settings import Address


@dataclass(frozen=True, slots=True)
class QueueConditions:
    """What waits for one peer on one priority level, and how that level fares."""

    priority: int
    messages: int
    bytes: int
    oldest_s: float
    """Age of the message at the head."""
    starved_s: float
    """Time in which this level waited while only more urgent ones were sent, since this run of ours began."""
    held_s: float
    """Time in which this level was held back for other robots' more urgent messages."""


@dataclass(frozen=True, slots=True)
class UnverifiedNode:
    """A node that is heard and does not hear us: no peer, since nothing would reach it."""

    name: str
    address: Address
    link: str
    met_at: float
    last_heard: float


@dataclass(frozen=True, slots=True)
class PeerConditions:
    """One peer. Rates are over the last second; times in seconds; None where nothing was measured yet."""

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
    """Share of packets lost on the way to the peer, 0 to 1, smoothed."""
    sent_bits_per_s: float
    """Wire bits of messages sent to the peer, with IP and UDP headers; acknowledgements and the like are left out."""
    delivered_bits_per_s: float
    """Payload bits the peer acknowledged."""
    received_bits_per_s: float
    """Wire bits received from the peer."""
    arrived_bits_per_s: float | None
    """Wire bits sent to the peer that arrive, as the peer itself says in its acknowledgements."""
    peer_sends_bits_per_s: float | None
    """Wire bits that the peer says it sends to everybody."""
    capacity_bits_per_s: float | None
    """The link's estimated rate for payload, where enough was sent to see it."""
    window_packets: float
    in_flight_packets: int
    retransmitted_packets: int
    queues: tuple[QueueConditions, ...]
    outbox_messages: int
    outbox_bytes: int
    one_way: bool
    """It is heard, and its heartbeats say that it does not hear us; if that lasts it is not online."""
    unanswered_for_s: float | None
    """So long nothing sent to it was answered, although it may be heard; None where nothing waits for an answer."""


@dataclass(slots=True)
class Counters:
    """Totals since the node's start. The node counts in its own; a snapshot holds a copy."""

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
    """Authentic, never seen before, and too old: a recording, or held back for longer than `ACCEPT_AGE_S`."""
    dropped_over_limit: int = 0
    events_dropped: int = 0
    repairs_asked: int = 0
    repairs_sent: int = 0


@dataclass(frozen=True, slots=True)
class Conditions:
    """A snapshot at `now`."""

    now: float
    name: str
    peers: tuple[PeerConditions, ...]
    counters: Counters
    sent_bits_per_s: float
    """Wire bits of this node, to everybody."""
    heard_bits_per_s: float
    """Wire bits that this node and the peers online say they send together: how busy the channel is."""
    partial_bytes: int
    queued_bytes: int
    repair_bytes: int
    strangers: tuple[UnverifiedNode, ...]
