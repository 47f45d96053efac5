"""A snapshot of the known subscriptions, and of the traffic they saved."""

from dataclasses import dataclass

from udp_mesh.core.subscriptions.messages import Subscription


@dataclass(slots=True)
class SavedCounters:
    """Messages that one peer (or none, for broadcasts) was not sent, since the node's start, and their bytes as they
    would have been sent, without headers. The node keeps one instance; a snapshot holds a copy."""

    unread_messages: int = 0
    """No program there reads them."""
    unread_bytes: int = 0
    thinned_messages: int = 0
    """Above the rate that programs there want."""
    thinned_bytes: int = 0
    aged_messages: int = 0
    """Older than programs there want."""
    aged_bytes: int = 0

    @property
    def messages(self) -> int:
        return self.unread_messages + self.thinned_messages + self.aged_messages

    @property
    def bytes(self) -> int:
        return self.unread_bytes + self.thinned_bytes + self.aged_bytes


@dataclass(frozen=True, slots=True)
class PeerSubscriptions:
    """One peer."""

    name: str
    known: bool
    """It announced what its programs read; otherwise it is sent everything."""
    subscriptions: tuple[Subscription, ...] | None
    """None: everything."""
    saved: SavedCounters


@dataclass(frozen=True, slots=True)
class SubscriptionConditions:
    """A snapshot."""

    selective: bool
    """This node announces what its programs read, and sends them only what theirs read."""
    own: tuple[Subscription, ...] | None
    """What is announced to peers; None: everything."""
    peers: tuple[PeerSubscriptions, ...]
    broadcasts: SavedCounters
    """Messages to all that no peer was to get."""
