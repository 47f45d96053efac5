"""Whether the peer acknowledges what is sent to it, as one transition table.

ACTIVE -> TIMING_OUT when packets time out -> UNRESPONSIVE without any progress; an acknowledgment or a restart of the
peer returns to ACTIVE.
"""

from enum import Enum


class SendState(Enum):
    ACTIVE = 1
    TIMING_OUT = 2
    """Acknowledgments stay away: packets are declared lost by their age."""
    UNRESPONSIVE = 3
    """Nothing was acknowledged for long, or the peer is offline: only probes are sent."""


class SendEvent(Enum):
    ACKNOWLEDGED = 1
    """The peer acknowledged something new."""
    TIMED_OUT = 2
    """Packets were declared lost by their age."""
    NO_PROGRESS = 3
    """Nothing was acknowledged for several timeouts, or the peer went offline."""
    RESTARTED = 4
    """The peer restarted: nothing is in flight."""


TRANSITIONS: dict[tuple[SendState, SendEvent], SendState] = {
    (SendState.ACTIVE, SendEvent.ACKNOWLEDGED): SendState.ACTIVE,
    (SendState.ACTIVE, SendEvent.TIMED_OUT): SendState.TIMING_OUT,
    (SendState.ACTIVE, SendEvent.NO_PROGRESS): SendState.UNRESPONSIVE,
    (SendState.ACTIVE, SendEvent.RESTARTED): SendState.ACTIVE,
    (SendState.TIMING_OUT, SendEvent.ACKNOWLEDGED): SendState.ACTIVE,
    (SendState.TIMING_OUT, SendEvent.TIMED_OUT): SendState.TIMING_OUT,
    (SendState.TIMING_OUT, SendEvent.NO_PROGRESS): SendState.UNRESPONSIVE,
    (SendState.TIMING_OUT, SendEvent.RESTARTED): SendState.ACTIVE,
    (SendState.UNRESPONSIVE, SendEvent.ACKNOWLEDGED): SendState.ACTIVE,
    (SendState.UNRESPONSIVE, SendEvent.TIMED_OUT): SendState.UNRESPONSIVE,
    (SendState.UNRESPONSIVE, SendEvent.NO_PROGRESS): SendState.UNRESPONSIVE,
    (SendState.UNRESPONSIVE, SendEvent.RESTARTED): SendState.ACTIVE,
}
