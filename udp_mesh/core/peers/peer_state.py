"""Whether a peer is reachable, as one transition table.

LOST -> ONLINE when heard -> OFFLINE when silent -> ONLINE when heard again, or LOST after `peer_lost_s`.
"""

from enum import Enum


class PeerState(Enum):
    LOST = 1
    """Never heard, or silent for `peer_lost_s`: messages wait only in an outbox."""
    OFFLINE = 2
    """Silent, or not hearing us: messages without an outbox wait for `peer_lost_s`."""
    ONLINE = 3


class PeerEvent(Enum):
    HEARD = 1
    """It is alive and hears us."""
    SILENT = 2
    """It was silent or did not hear us for too long, or said goodbye."""
    GIVEN_UP = 3
    """`peer_lost_s` is over."""
    CONFIGURED = 4
    """A legacy neighbor was configured: messages wait for it before it is first heard."""


TRANSITIONS: dict[tuple[PeerState, PeerEvent], PeerState] = {
    (PeerState.LOST, PeerEvent.HEARD): PeerState.ONLINE,
    (PeerState.LOST, PeerEvent.SILENT): PeerState.LOST,
    (PeerState.LOST, PeerEvent.GIVEN_UP): PeerState.LOST,
    (PeerState.LOST, PeerEvent.CONFIGURED): PeerState.OFFLINE,
    (PeerState.OFFLINE, PeerEvent.HEARD): PeerState.ONLINE,
    (PeerState.OFFLINE, PeerEvent.SILENT): PeerState.OFFLINE,
    (PeerState.OFFLINE, PeerEvent.GIVEN_UP): PeerState.LOST,
    (PeerState.OFFLINE, PeerEvent.CONFIGURED): PeerState.OFFLINE,
    (PeerState.ONLINE, PeerEvent.HEARD): PeerState.ONLINE,
    (PeerState.ONLINE, PeerEvent.SILENT): PeerState.OFFLINE,
    (PeerState.ONLINE, PeerEvent.GIVEN_UP): PeerState.ONLINE,
    (PeerState.ONLINE, PeerEvent.CONFIGURED): PeerState.ONLINE,
}
