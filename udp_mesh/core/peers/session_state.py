"""The state of a session's proof, and of whether its peer hears us, each as one transition table.

NEW, RESTORED or RETURNED -> VERIFIED once it proves that it hears our current boot.

UNKNOWN -> HEARS_US when it answers -> LISTS_US when its heartbeats list us -> ONE_WAY when they no longer do.
"""

from enum import Enum


class SessionState(Enum):
    NEW = 1
    """Not verified: only its heartbeats are believed."""
    RESTORED = 2
    """Not verified; an earlier session of this boot was dropped, and its counters were restored."""
    RETURNED = 3
    """RESTORED under the same name, which another boot may have taken meanwhile."""
    VERIFIED = 4


class SessionEvent(Enum):
    OTHER_NAME_RESTORED = 1
    """Counters of an earlier session under another name were restored."""
    SAME_NAME_RESTORED = 2
    VERIFIED = 3
    """It proved that it hears our current boot."""


SESSION_TRANSITIONS: dict[tuple[SessionState, SessionEvent], SessionState] = {
    (SessionState.NEW, SessionEvent.OTHER_NAME_RESTORED): SessionState.RESTORED,
    (SessionState.NEW, SessionEvent.SAME_NAME_RESTORED): SessionState.RETURNED,
    (SessionState.NEW, SessionEvent.VERIFIED): SessionState.VERIFIED,
    (SessionState.RESTORED, SessionEvent.VERIFIED): SessionState.VERIFIED,
    (SessionState.RETURNED, SessionEvent.VERIFIED): SessionState.VERIFIED,
}
"""Counters are restored only when a session is made, so other pairs do not occur."""


class Reception(Enum):
    """Whether the peer hears us."""

    UNKNOWN = 1
    HEARS_US = 2
    """It answered us, or listed us: introductions need no name any more."""
    LISTS_US = 3
    """Its broadcast heartbeats list us, so one that no longer does is significant."""
    ONE_WAY = 4
    """Its heartbeats no longer list us, and it acknowledges nothing: only its direction to us works."""


class ReceptionEvent(Enum):
    ACKNOWLEDGED = 1
    """It acknowledged a packet, which may have been long ago."""
    CONFIRMED = 2
    """It acknowledged something recent, or listed us in a unicast heartbeat."""
    LISTED = 3
    """A broadcast heartbeat lists us."""
    NOT_LISTED = 4
    """A broadcast heartbeat does not list us although it has room."""


RECEPTION_TRANSITIONS: dict[tuple[Reception, ReceptionEvent], Reception] = {
    (Reception.UNKNOWN, ReceptionEvent.ACKNOWLEDGED): Reception.HEARS_US,
    (Reception.UNKNOWN, ReceptionEvent.CONFIRMED): Reception.HEARS_US,
    (Reception.UNKNOWN, ReceptionEvent.LISTED): Reception.LISTS_US,
    (Reception.UNKNOWN, ReceptionEvent.NOT_LISTED): Reception.UNKNOWN,
    (Reception.HEARS_US, ReceptionEvent.ACKNOWLEDGED): Reception.HEARS_US,
    (Reception.HEARS_US, ReceptionEvent.CONFIRMED): Reception.HEARS_US,
    (Reception.HEARS_US, ReceptionEvent.LISTED): Reception.LISTS_US,
    (Reception.HEARS_US, ReceptionEvent.NOT_LISTED): Reception.HEARS_US,
    (Reception.LISTS_US, ReceptionEvent.ACKNOWLEDGED): Reception.LISTS_US,
    (Reception.LISTS_US, ReceptionEvent.CONFIRMED): Reception.LISTS_US,
    (Reception.LISTS_US, ReceptionEvent.LISTED): Reception.LISTS_US,
    (Reception.LISTS_US, ReceptionEvent.NOT_LISTED): Reception.ONE_WAY,
    (Reception.ONE_WAY, ReceptionEvent.ACKNOWLEDGED): Reception.ONE_WAY,
    (Reception.ONE_WAY, ReceptionEvent.CONFIRMED): Reception.LISTS_US,
    (Reception.ONE_WAY, ReceptionEvent.LISTED): Reception.LISTS_US,
    (Reception.ONE_WAY, ReceptionEvent.NOT_LISTED): Reception.ONE_WAY,
}
