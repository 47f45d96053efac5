"""Whether large datagrams vanish on a path that carries small ones: packets lost and arrived in -> a narrower path.

Some tunnel or mesh on the way may carry less than our own interface, and say nothing of it (RFC 8899 calls that a black
hole). A large datagram is one that the next narrower path would not carry.
1. A round is a small datagram that arrived some time after the last one while large ones kept being lost.
2. After a few rounds in which nothing arrived that is as large as the least that was lost, the loss of small ones,
   measured meanwhile, says how likely it is that the large ones vanished by chance. Where that is next to nothing the
   path is taken for narrower.
3. From then on pings as large as what was given up ask, ever more seldom, whether the path carries it after all.
"""

from collections.abc import Iterable, Sequence

from udp_mesh.core.sender.sent_packets import Packet
from udp_mesh.wire.codec import FRAGMENT_BYTES, HEAD_BYTES, LENGTH_BYTES

ETHERNET_MTU = 1500
"""RFC 894."""

NARROWER_MTUS = (ETHERNET_MTU, 1280, 576)
"""What to try next, in bytes of IP packet: Ethernet's behind larger ones, the least that IPv6 links carry
(RFC 8200, 5), and the least that every IPv4 host takes (RFC 1122, 3.3.2)."""

ROUNDS = 4
ROUND_S = 0.3
LOST_PER_ROUND = 2
"""At least eight large datagrams in more than a second."""

CHANCE = 1e-6
"""Less likely than this, at the loss of small ones, so many large ones in a row are not lost by chance."""

APART_S = 0.1
"""Large datagrams that left closer together count as one: what loses one of them often loses the others as well."""

MOST_AT_A_STRETCH = 8
"""And no more of them between two small ones that arrived, but for two with each small one lost: a cut loses both."""

MOST_SMALL_AT_A_STRETCH = 32
"""Small ones lost between two that arrived: a cut says nothing more however long it lasts."""

MEMORY = 64
"""Small datagrams over which their loss is remembered from one doubt to the next: of a few all may arrive by chance."""

DOUBT_S = 2.5
"""And no large datagram acknowledged for so long since the first round: on a path whose round trip has just become a
second or two their acknowledgements are still to come, and what is cut anew although it arrived arrives twice."""

PROBES_PER_SMALL = LOST_PER_ROUND + 1
"""Of the probes of a silent peer one in so many is small: a round takes the others."""

ASK_AFTER_S = 10.0
ASK_AT_MOST_EVERY_S = 600.0
"""The larger size is asked for after the first, then after twice as long each time, at last with RFC 8899's
PMTU_RAISE_TIMER. A mistake costs a tenth of the rate until then; a path that is narrow, three pings each
time."""

ASKED_TIMES = 3
"""Pings of a size per time that would be answered (RFC 8899's MAX_PROBES) if as many got through as the loss says: one
alone proves little."""

LEAST_ARRIVING = 0.3
"""Of pings and answers each, whatever the loss: 33 per time at most."""

LARGE_AT_FIRST_BYTES = 1200
"""Until the first look at the way, some half second: about what frames take on the narrowest of IPv6 links."""

_INFINITY = float("inf")


class PathMtu:
    """What is known about one peer's path. `narrowed_at` is when it was last taken for narrower."""

    __slots__ = (
        "_between",
        "_between_small",
        "_counted_at",
        "_doubted_at",
        "_in_a_row",
        "_least_lost",
        "_lost",
        "_probes",
        "_remembered",
        "_remembered_lost",
        "_round_at",
        "_rounds",
        "_small",
        "_small_lost",
        "large_bytes",
        "narrowed_at",
        "probe",
    )

    def __init__(self) -> None:
        self.large_bytes: float = LARGE_AT_FIRST_BYTES
        """Frames of a datagram that is not large, at most; where nothing narrower is to be tried all are small."""
        self._lost = 0
        """Large datagrams lost in this round."""
        self._least_lost = _INFINITY
        """Frames of the smallest of them since the doubt began."""
        self._rounds = 0
        self._round_at = 0.0
        self._doubted_at = 0.0
        self._in_a_row = 0
        """Large datagrams lost since the doubt began, apart from each other."""
        self._counted_at = float("-inf")
        """When the last of those left."""
        self._small = self._small_lost = 0
        """Small datagrams since the doubt began."""
        self._between = self._between_small = 0
        """Of both, the lost ones since a small one arrived."""
        self._remembered = self._remembered_lost = 0.0
        """Small datagrams of earlier doubts."""
        self._probes = 0
        self.narrowed_at: float | None = None
        self.probe = PmtuProbe()

    @property
    def in_doubt(self) -> bool:
        """Large datagrams were lost and none arrived since."""
        return self._lost > 0 or self._rounds > 0

    # Doubt

    def lost(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            size = _frames_bytes(packet)
            if size > self.large_bytes:
                self._lost += 1
                self._least_lost = min(self._least_lost, size)
                left_at = packet.snapshot.sent_at
                most = MOST_AT_A_STRETCH + LOST_PER_ROUND * self._between_small
                if left_at >= self._counted_at + APART_S and self._between < most:
                    self._counted_at = left_at
                    self._between += 1
                    self._in_a_row += 1
            elif self.in_doubt:
                self._small_is_lost()

    def arrived(self, packets: Sequence[Packet], called_lost: int, now: float) -> None:
        """Only to be told while `in_doubt`; so many of them were called lost before."""
        least = self._least_lost
        if any(_frames_bytes(packet) >= least for packet in packets):
            self.reset()
        else:
            self._small_arrived(len(packets), called_lost, now)

    def ask_small(self) -> bool:
        """Whether the next probe of a silent peer shall be small."""
        self._probes += 1
        return self.in_doubt and not self._probes % PROBES_PER_SMALL

    def asked_small(self) -> None:
        """A small ping left: lost, unless it is answered."""
        if self.in_doubt:
            self._small_is_lost()

    def answered(self, token: int, now: float) -> None:
        """A ping was answered."""
        if not self.probe.answered(token) and self.in_doubt:
            self._small_arrived(1, 1, now)

    def _small_is_lost(self) -> None:
        if self._between_small < MOST_SMALL_AT_A_STRETCH:
            self._between_small += 1
            self._small += 1
            self._small_lost += 1

    def _small_arrived(self, count: int, called_lost: int, now: float) -> None:
        called_lost = min(called_lost, self._small_lost)
        self._small_lost -= called_lost
        self._small += count - called_lost
        self._between = self._between_small = 0
        if self._lost >= LOST_PER_ROUND and now - self._round_at >= ROUND_S:
            if not self._rounds:
                self._doubted_at = now
            self._rounds += 1
            self._lost = 0
            self._round_at = now

    def too_narrow(self, now: float) -> bool:
        """Large datagrams do not get through."""
        if self._rounds < ROUNDS or now - self._doubted_at < DOUBT_S:
            return False
        small_loss = max(
            (self._small_lost + 1) / (self._small + 2),
            (self._remembered_lost + self._small_lost + 1) / (self._remembered + self._small + 2),
        )
        return bool(small_loss**self._in_a_row < CHANCE)

    def reset(self) -> None:
        """A large datagram arrived, or their size is another from now on."""
        self._remembered += self._small
        self._remembered_lost += self._small_lost
        if self._remembered > MEMORY:
            self._remembered_lost *= MEMORY / self._remembered
            self._remembered = MEMORY
        self._lost = self._rounds = self._in_a_row = self._small = self._small_lost = 0
        self._between = self._between_small = 0
        self._least_lost = _INFINITY

    # Narrowed

    def narrowed(self, now: float) -> None:
        """The path is taken for narrower from now on."""
        self.reset()
        self.probe.begin(now)
        self.narrowed_at = now


class PmtuProbe:
    """When to ask whether a path carries more than it is given, and what was answered."""

    __slots__ = ("_at", "_begun_at", "_pause_s", "_times", "_tokens", "carries")

    def __init__(self) -> None:
        self._begun_at = float("-inf")
        self._at = float("inf")
        self._pause_s = ASK_AFTER_S
        self._times = 0
        self._tokens: dict[int, int] = {}
        """Of pings that may still be answered -> the MTU they fill."""
        self.carries = 0
        """The largest MTU for which one was answered."""

    def begin(self, now: float) -> None:
        """The path is taken for narrow from now on. Where a ping was answered not long ago that proved little."""
        if now - self._begun_at > 2 * ASK_AT_MOST_EVERY_S:
            self._pause_s = ASK_AFTER_S
        elif self.carries:
            self._pause_s = min(2 * self._pause_s, ASK_AT_MOST_EVERY_S)
        self._begun_at = now
        self.carries = 0
        self._tokens.clear()
        self._wait(now)

    def _wait(self, now: float) -> None:
        self._at = now + self._pause_s
        self._times = 0

    def due(self, now: float, loss: float) -> bool:
        """Whether to ask now; to be called some times a second at most, and only while the peer answers. `loss` is that
        of datagrams to the peer."""
        if now < self._at:
            return False
        if not self._times:
            self._tokens.clear()
        self._times += 1
        if self._times >= ASKED_TIMES / max(LEAST_ARRIVING, 1 - loss) ** 2:
            self._pause_s = min(2 * self._pause_s, ASK_AT_MOST_EVERY_S)
            self._wait(now)
        return True

    def asked(self, token: int, mtu: int) -> None:
        self._tokens[token] = mtu

    def answered(self, token: int) -> bool:
        """Whether it was one of these pings."""
        mtu = self._tokens.pop(token, None)
        if mtu is not None:
            self.carries = max(self.carries, mtu)
        return mtu is not None


def _frames_bytes(packet: Packet) -> int:
    """About what the packet's frames take: a topic's name is left out."""
    _, message, position, more = packet
    start, end = message.span(position)
    size = FRAGMENT_BYTES + end - start + (0 if position else HEAD_BYTES)
    for message, position in more:
        start, end = message.span(position)
        size += FRAGMENT_BYTES + LENGTH_BYTES + end - start + (0 if position else HEAD_BYTES)
    return size
