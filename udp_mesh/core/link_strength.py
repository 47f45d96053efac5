"""Whether the link to a peer is weak: how much of what it sends to all arrives.

The radio sends these datagrams once; others it repeats, so that their loss shows only when the link breaks. What is
lost while a peer is out of reach says nothing about its link after its return: the count begins with what is heard
then. A shorter pause is loss like any other: at the edge of their range, robots do not hear each other for seconds.
"""

from __future__ import annotations

from udp_mesh.core.peers.session import Session

WEAK_SHARE = 0.7
"""A link over which less arrives is weak."""
WEAK_DATAGRAMS, LEAST_DATAGRAMS = 8, 4
"""Of so many of the newest ones, and of no fewer: robots may meet for seconds."""
ABSENT_HEARTBEATS = 5.0
"""A peer that was not heard for so many of its heartbeat intervals was out of reach."""


class LinkStrength:
    """The link of one session. Call `is_weak` about once per second."""

    __slots__ = ("_first", "_known", "_silent_for", "session")

    def __init__(self, session: Session) -> None:
        self.session = session
        self._begin()

    def _begin(self) -> None:
        self._known = self.session.broadcast_channels[0].window.next_new
        self._first: int | None = None
        """The first datagram to all that counts: the one after the first that is heard, whatever was lost before."""
        self._silent_for = 0.0
        """In heartbeat intervals, when this was last checked."""

    def is_weak(self, now: float) -> bool:
        silent_for = (now - self.session.last_heard) / self.session.interval_s
        if silent_for < self._silent_for and self._silent_for > ABSENT_HEARTBEATS:
            self._begin()
        self._silent_for = silent_for
        window = self.session.broadcast_channels[0].window
        if self._first is None:
            if window.next_new == self._known:
                return False
            self._first = window.next_new
        share = window.accepted_share(self._first, WEAK_DATAGRAMS, LEAST_DATAGRAMS)
        return share is not None and share < WEAK_SHARE
