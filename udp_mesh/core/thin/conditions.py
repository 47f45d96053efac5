"""Thin links and the nodes on them, for the status page and the metrics."""

from __future__ import annotations

from dataclasses import dataclass

from udp_mesh.core.thin.link import ThinLinkCounters


@dataclass(frozen=True, slots=True)
class ThinLinkConditions:
    """One thin link. Times in seconds."""

    name: str
    up: bool
    bits_per_s: float
    frame_bytes: int
    budget_s: float
    """Airtime that this node may use in `window_s`."""
    window_s: float
    burst_s: float
    """Airtime that may be used at once, if the budget is full."""
    available_s: float
    """Airtime that may be used now."""
    airtime_s: float
    """Airtime used since the start."""
    waits_for_budget_s: float | None
    """Until the budget has room for the next frame; None if nothing waits for it."""
    queued_messages: int
    rejecting_s: float | None
    """How long the link still accepts nothing, because too many frames were forged; None if it accepts."""
    failed_authentications: int
    """In the present period of the limit."""
    counters: ThinLinkCounters


@dataclass(frozen=True, slots=True)
class ThinPeerConditions:
    """One node that is heard on thin links."""

    name: str
    number: int
    links: tuple[str, ...]
    """Those on which it was heard last."""
    heard_ago_s: float
    present: bool
    """It was heard recently, and hears this node."""
    only_thin: bool
    """No other link reaches it."""
    conflicting_name: str
    """The name of another node that had the same number."""


@dataclass(frozen=True, slots=True)
class ThinConditions:
    """All of it."""

    number: int
    links: tuple[ThinLinkConditions, ...]
    peers: tuple[ThinPeerConditions, ...]
    own_number_used_by: str
    copies_dropped: int
    """Copies of messages that had arrived already: over another link, or because an acknowledgment was lost."""
    unknown_topics: int
    """Messages of topics that this node does not have on thin links."""
    too_large: int
    """Messages sent that are too large for a thin link."""
