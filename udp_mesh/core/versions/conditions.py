"""Counters of versions sent and received per topic: the decisions and the savings."""

from dataclasses import dataclass


@dataclass(slots=True)
class VersionCounters:
    """Totals of one topic since the node's start, over all peers. The node keeps one instance; a snapshot holds a
    copy."""

    whole_sent: int = 0
    """Versions sent whole, `not_tried` included."""
    differences_sent: int = 0
    not_tried: int = 0
    """Sent whole without trying a difference, though the peer has a base: too large, too many bytes a second, or the
    last differences saved nothing."""
    bases_lost: int = 0
    """Differences that a peer could not decode, because it did not have the base any more: sent again whole."""
    payload_bytes_sent: int = 0
    """Sizes of these versions as passed to `send`."""
    body_bytes_sent: int = 0
    """Their sizes on the wire, without fragment headers and retransmissions."""
    whole_received: int = 0
    differences_received: int = 0
    bases_missing: int = 0
    """Differences received to a version that is not held here: the whole was requested."""
    damaged: int = 0
    """Differences whose result had the wrong hash: the whole was requested."""
    payload_bytes_received: int = 0
    body_bytes_received: int = 0


@dataclass(frozen=True, slots=True)
class VersionConditions:
    """One topic."""

    topic: str
    counters: VersionCounters

    @property
    def saved_bytes(self) -> int:
        """Bytes that were not sent because differences, or zstd, were smaller."""
        return self.counters.payload_bytes_sent - self.counters.body_bytes_sent
