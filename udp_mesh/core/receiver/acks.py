"""Acknowledgment state of one peer: packet numbers in -> an acknowledgment now, soon, or not yet.

An acknowledgment carries the largest packet number and a 256-bit bitmap below it. It is sent after a number of packets
or a delay, whichever comes first, or at once if a packet requests it.
"""

from __future__ import annotations

from udp_mesh.wire.limits import ACK_BITMAP_BITS

_ALL = (1 << (ACK_BITMAP_BITS + 1)) - 1

MAX_PENDING = ACK_BITMAP_BITS // 4
"""An acknowledgment is due after this many packets in any case, so that each packet appears in four of them."""


LARGE_WINDOW_SPACING = 8
"""Packets between two requests of a sender whose window is so large that a millisecond is a small part of it."""


class AckState:
    """`received` has bit 0 for `largest` itself and bit i for `largest - i`."""

    __slots__ = ("arrived_at", "due_at", "largest", "overtaken", "pending", "received", "requested", "send_now")

    def __init__(self) -> None:
        self.largest = -1
        self.received = 0
        self.pending = 0
        """Packets that request an acknowledgment, since the last one was sent."""
        self.requested = 0
        """Those of them that request one at once."""
        self.arrived_at = 0.0
        """When `largest` arrived."""
        self.due_at: float | None = None
        self.send_now = False
        self.overtaken: AckState | None = None
        """Of packets that an urgent one overtook by more than the bitmap, in a socket's queue or a radio's: they are
        acknowledged on their own, or the sender would take them for lost."""

    def on_packet(self, number: int, now: float) -> None:
        """Record a packet (each number once: the replay window comes first)."""
        ahead = number - self.largest
        if ahead == 1:
            self.received = (self.received << 1 | 1) & _ALL
            self.largest = number
            self.arrived_at = now
        elif ahead > 0:
            self.received = (self.received << ahead | 1) & _ALL if ahead <= ACK_BITMAP_BITS else 1
            self.largest = number
            self.arrived_at = now
        elif -ahead <= ACK_BITMAP_BITS:
            self.received |= 1 << -ahead
        else:
            if self.overtaken is None:
                self.overtaken = AckState()
            if number > self.overtaken.largest - ACK_BITMAP_BITS:
                self.overtaken.on_packet(number, now)
                self.overtaken.pending += 1

    @property
    def is_late(self) -> bool:
        """Whether the sender has requested another acknowledgment before this one was sent, which it does every fifth
        of its window."""
        return self.requested > 1 and self.pending < LARGE_WINDOW_SPACING * self.requested

    def on_ack_sent(self) -> None:
        """Record that an acknowledgment was sent."""
        if self.overtaken is not None:
            self.overtaken.pending = 0
        self.pending = 0
        self.requested = 0
        self.due_at = None
        self.send_now = False
