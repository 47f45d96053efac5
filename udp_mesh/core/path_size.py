"""Whether large datagrams vanish on a path that carries small ones: packets lost and arrived in -> a narrower path.

Some tunnel or mesh on the way may carry less than our own interface, and say nothing of it (RFC 8899 calls that a black
hole). A round is a small datagram that arrived some time after the last one while full pieces kept being lost; after a
few rounds without one full piece arriving the path is taken for narrower. A cut loses small datagrams as well, and
any loss that is not by size lets a full piece through long before.
"""

from collections.abc import Iterable

from udp_mesh.core.flight import Packet

NARROWER_MTUS = (1280, 576)
"""What to try next, in bytes of IP packet: the least that IPv6 links carry (RFC 8200, 5), and the least that every IPv4
host takes (RFC 1122, 3.3.2)."""

ROUNDS = 4
ROUND_S = 0.3
LOST_PER_ROUND = 2
"""At least eight full pieces in more than a second: with half of all datagrams lost that happens once in some hundred
times, and costs a tenth of the rate until `WIDEN_AFTER_S`."""

DOUBT_S = 2.5
"""And no full piece acknowledged for so long since the first round: on a path whose round trip has just become a second
or two their acknowledgements are still to come, and what is cut anew although it arrived arrives twice."""

PROBES_PER_SMALL = LOST_PER_ROUND + 1
"""Of the probes of a silent peer one in so many is small: a round takes the others."""

WIDEN_AFTER_S = 600.0
"""The larger size is tried again (RFC 8899's PMTU_RAISE_TIMER)."""

FULL = 0.85
"""Part of a fragment's size from which on a piece counts as a full one: the first carries the head besides."""

LEAST_FULL_BYTES = 450
"""Fragments of the narrowest path are smaller than that plus their headers: nothing narrower is tried."""


class PathSize:
    """What is known about one peer's path. `narrowed_at` is when it was last taken for narrower."""

    __slots__ = ("_asked", "_doubted_at", "_lost", "_round_at", "_rounds", "narrowed_at")

    def __init__(self) -> None:
        self._lost = 0
        """Full pieces lost in this round."""
        self._rounds = 0
        self._round_at = 0.0
        self._doubted_at = 0.0
        self._asked = 0
        self.narrowed_at: float | None = None

    @property
    def in_doubt(self) -> bool:
        """Full pieces were lost and none arrived since."""
        return self._lost > 0 or self._rounds > 0

    def too_narrow(self, now: float) -> bool:
        """Full pieces do not get through."""
        return self._rounds >= ROUNDS and now - self._doubted_at >= DOUBT_S

    def ask(self) -> bool:
        """Whether the next probe shall be small."""
        self._asked += 1
        return self.in_doubt and not self._asked % PROBES_PER_SMALL

    def reset(self) -> None:
        """A full piece arrived, or their size is another from now on."""
        self._lost = self._rounds = 0

    def lost(self, packets: Iterable[Packet]) -> None:
        self._lost += sum(map(_is_full, packets))

    def arrived(self, packets: Iterable[Packet], now: float) -> None:
        """Only to be told while `in_doubt`."""
        if any(map(_is_full, packets)):
            self.reset()
        else:
            self.small_arrived(now)

    def small_arrived(self, now: float) -> None:
        """A small datagram got there."""
        if self._lost >= LOST_PER_ROUND and now - self._round_at >= ROUND_S:
            if not self._rounds:
                self._doubted_at = now
            self._rounds += 1
            self._lost = 0
            self._round_at = now


def _is_full(packet: Packet) -> bool:
    message = packet.message
    start, end = message.span(packet.position)
    return end - start >= max(LEAST_FULL_BYTES, FULL * message.fragment_bytes)
