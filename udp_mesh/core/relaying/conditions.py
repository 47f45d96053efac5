"""A node's view of relays: its neighbors, the routes to other nodes, and counters of forwarded datagrams."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RelayNeighbor:
    """A node heard directly that takes part in relaying."""

    name: str
    link: str | None
    relays: bool
    """It passes datagrams on."""
    member: bool
    """It holds one of our fleet keys; a relay that does not cannot read what it passes on."""
    quality: float
    """Share of hellos that arrive, in both directions together, 0 to 1."""
    unanswered: bool
    """What is sent to it is not acknowledged."""
    queued_bytes: int
    window_packets: float
    round_trip_s: float | None


@dataclass(frozen=True, slots=True)
class RelayRoute:
    """A node that is reached through relays, or could be."""

    name: str
    via: tuple[str, ...]
    """The relays on the way, the nearest first, as far as known."""
    hops: int
    """Links between this node and it."""
    cost: float
    """Expected transmissions."""
    mtu: int
    common_key: bool
    """It holds one of our fleet keys; otherwise nothing is sent to it."""
    readable_by: tuple[str, ...]
    """Relays of `via` that hold one of our fleet keys, and so could read what they pass on."""
    in_use: bool
    """Datagrams to it leave this way; otherwise it is reached directly."""


@dataclass(slots=True)
class RelayCounters:
    """Totals since the node's start, in datagrams where nothing else is said."""

    passed_on: int = 0
    passed_on_bytes: int = 0
    sent: int = 0
    """Our own, sent through a relay."""
    received: int = 0
    """For us, through a relay."""
    dropped_queue: int = 0
    """No room in the queue of their origin, or waited too long."""
    dropped_unreachable: int = 0
    dropped_refused: int = 0
    """Neither end is named in `relay`, or more hops than configured."""
    dropped_loop: int = 0
    dropped_unauthenticated: int = 0
    """Of no neighbor, forged, or replayed."""


@dataclass(frozen=True, slots=True)
class RelayConditions:
    """A snapshot."""

    relays: bool
    """This node passes datagrams on."""
    active: bool
    """It relays, or hears a relay."""
    neighbours: tuple[RelayNeighbor, ...]
    routes: tuple[RelayRoute, ...]
    counters: RelayCounters
    queued_bytes: int
