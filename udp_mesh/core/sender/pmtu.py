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

MAX_CHANCE = 1e-6
"""Less likely than this, at the loss of small ones, so many large ones in a row are not lost by chance."""

LOSS_SPACING_S = 0.1
"""Large datagrams that left closer together count as one: what loses one of them often loses the others as well."""

MAX_LARGE_LOST_BETWEEN = 8
"""And no more of them between two small ones that arrived, but for two with each small one lost: a cut loses both."""

MAX_SMALL_LOST_BETWEEN = 32
"""Small ones lost between two that arrived: a cut says nothing more however long it lasts."""

LOSS_MEMORY_PACKETS = 64
"""Small datagrams over which their loss is remembered from one doubt to the next: of a few all may arrive by chance."""

SUSPECT_S = 2.5
"""And no large datagram acknowledged for so long since the first round: on a path whose round trip has just become a
second or two their acknowledgements are still to come, and what is cut anew although it arrived arrives twice."""

PROBES_PER_SMALL = LOST_PER_ROUND + 1
"""Of the probes of a silent peer one in so many is small: a round takes the others."""

PROBE_AFTER_S = 10.0
MAX_PROBE_INTERVAL_S = 600.0
"""The larger size is asked for after the first, then after twice as long each time, at last with RFC 8899's
PMTU_RAISE_TIMER. A mistake costs a tenth of the rate until then; a path that is narrow, three pings each
time."""

MAX_PROBES = 3
"""Pings of a size per time that would be answered (RFC 8899's MAX_PROBES) if as many got through as the loss says: one
alone proves little."""

MIN_ARRIVING = 0.3
"""Of pings and answers each, whatever the loss: 33 per time at most."""

INITIAL_LARGE_BYTES = 1200
"""Until the first look at the way, some half second: about what frames take on the narrowest of IPv6 links."""

_INFINITY = float("inf")


class PathMtu:
    """What is known about one peer's path. `narrowed_at` is when it was last taken for narrower."""

    __slots__ = (
        "_counted_at",
        "_large_lost",
        "_large_lost_between",
        "_large_lost_in_a_row",
        "_past_small",
        "_past_small_lost",
        "_probes",
        "_round_at",
        "_rounds",
        "_small",
        "_small_lost",
        "_small_lost_between",
        "_smallest_lost",
        "_suspect_since",
        "large_bytes",
        "narrowed_at",
        "probe",
    )

    def __init__(self) -> None:
        self.large_bytes: float = INITIAL_LARGE_BYTES
        """Frames of a datagram that is not large, at most; where nothing narrower is to be tried all are small."""
        self._large_lost = 0
        """Large datagrams lost in this round."""
        self._smallest_lost = _INFINITY
        """Frames of the smallest of them since the doubt began."""
        self._rounds = 0
        self._round_at = 0.0
        self._suspect_since = 0.0
        self._large_lost_in_a_row = 0
        """Large datagrams lost since the doubt began, apart from each other."""
        self._counted_at = float("-inf")
        """When the last of those left."""
        self._small = self._small_lost = 0
        """Small datagrams since the doubt began."""
        self._large_lost_between = self._small_lost_between = 0
        """Of both, the lost ones since a small one arrived."""
        self._past_small = self._past_small_lost = 0.0
        """Small datagrams of earlier doubts."""
        self._probes = 0
        self.narrowed_at: float | None = None
        self.probe = PmtuProbe()

    @property
    def suspect(self) -> bool:
        """Large datagrams were lost and none arrived since."""
        return self._large_lost > 0 or self._rounds > 0

    # Doubt

    def on_lost(self, packets: Iterable[Packet]) -> None:
        for packet in packets:
            size = _frames_bytes(packet)
            if size > self.large_bytes:
                self._large_lost += 1
                self._smallest_lost = min(self._smallest_lost, size)
                left_at = packet.snapshot.sent_at
                max_lost = MAX_LARGE_LOST_BETWEEN + LOST_PER_ROUND * self._small_lost_between
                if left_at >= self._counted_at + LOSS_SPACING_S and self._large_lost_between < max_lost:
                    self._counted_at = left_at
                    self._large_lost_between += 1
                    self._large_lost_in_a_row += 1
            elif self.suspect:
                self._on_small_lost()

    def on_acked(self, packets: Sequence[Packet], called_lost: int, now: float) -> None:
        """Only to be told while `suspect`; so many of them were called lost before."""
        smallest = self._smallest_lost
        if any(_frames_bytes(packet) >= smallest for packet in packets):
            self.reset()
        else:
            self._on_small_acked(len(packets), called_lost, now)

    def next_probe_is_small(self) -> bool:
        """Whether the next probe of a silent peer shall be small."""
        self._probes += 1
        return self.suspect and not self._probes % PROBES_PER_SMALL

    def on_small_probe_sent(self) -> None:
        """A small ping left: lost, unless it is answered."""
        if self.suspect:
            self._on_small_lost()

    def on_pong(self, token: int, now: float) -> None:
        """A ping was answered."""
        if not self.probe.on_pong(token) and self.suspect:
            self._on_small_acked(1, 1, now)

    def _on_small_lost(self) -> None:
        if self._small_lost_between < MAX_SMALL_LOST_BETWEEN:
            self._small_lost_between += 1
            self._small += 1
            self._small_lost += 1

    def _on_small_acked(self, count: int, called_lost: int, now: float) -> None:
        called_lost = min(called_lost, self._small_lost)
        self._small_lost -= called_lost
        self._small += count - called_lost
        self._large_lost_between = self._small_lost_between = 0
        if self._large_lost >= LOST_PER_ROUND and now - self._round_at >= ROUND_S:
            if not self._rounds:
                self._suspect_since = now
            self._rounds += 1
            self._large_lost = 0
            self._round_at = now

    def is_black_hole(self, now: float) -> bool:
        """Large datagrams do not get through."""
        if self._rounds < ROUNDS or now - self._suspect_since < SUSPECT_S:
            return False
        small_loss = max(
            (self._small_lost + 1) / (self._small + 2),
            (self._past_small_lost + self._small_lost + 1) / (self._past_small + self._small + 2),
        )
        return bool(small_loss**self._large_lost_in_a_row < MAX_CHANCE)

    def reset(self) -> None:
        """A large datagram arrived, or their size is another from now on."""
        self._past_small += self._small
        self._past_small_lost += self._small_lost
        if self._past_small > LOSS_MEMORY_PACKETS:
            self._past_small_lost *= LOSS_MEMORY_PACKETS / self._past_small
            self._past_small = LOSS_MEMORY_PACKETS
        self._large_lost = self._rounds = self._large_lost_in_a_row = self._small = self._small_lost = 0
        self._large_lost_between = self._small_lost_between = 0
        self._smallest_lost = _INFINITY

    # Narrowed

    def on_narrowed(self, now: float) -> None:
        """The path is taken for narrower from now on."""
        self.reset()
        self.probe.start(now)
        self.narrowed_at = now


class PmtuProbe:
    """When to ask whether a path carries more than it is given, and what was answered."""

    __slots__ = ("_interval_s", "_next_at", "_sent_probes", "_started_at", "_tokens", "confirmed_mtu")

    def __init__(self) -> None:
        self._started_at = float("-inf")
        self._next_at = float("inf")
        self._interval_s = PROBE_AFTER_S
        self._sent_probes = 0
        self._tokens: dict[int, int] = {}
        """Of pings that may still be answered -> the MTU they fill."""
        self.confirmed_mtu = 0
        """The largest MTU for which one was answered."""

    def start(self, now: float) -> None:
        """The path is taken for narrow from now on. Where a ping was answered not long ago that proved little."""
        if now - self._started_at > 2 * MAX_PROBE_INTERVAL_S:
            self._interval_s = PROBE_AFTER_S
        elif self.confirmed_mtu:
            self._interval_s = min(2 * self._interval_s, MAX_PROBE_INTERVAL_S)
        self._started_at = now
        self.confirmed_mtu = 0
        self._tokens.clear()
        self._schedule(now)

    def _schedule(self, now: float) -> None:
        self._next_at = now + self._interval_s
        self._sent_probes = 0

    def due(self, now: float, loss: float) -> bool:
        """Whether to ask now; to be called some times a second at most, and only while the peer answers. `loss` is that
        of datagrams to the peer."""
        if now < self._next_at:
            return False
        if not self._sent_probes:
            self._tokens.clear()
        self._sent_probes += 1
        if self._sent_probes >= MAX_PROBES / max(MIN_ARRIVING, 1 - loss) ** 2:
            self._interval_s = min(2 * self._interval_s, MAX_PROBE_INTERVAL_S)
            self._schedule(now)
        return True

    def on_probe_sent(self, token: int, mtu: int) -> None:
        self._tokens[token] = mtu

    def on_pong(self, token: int) -> bool:
        """Whether it was one of these pings."""
        mtu = self._tokens.pop(token, None)
        if mtu is not None:
            self.confirmed_mtu = max(self.confirmed_mtu, mtu)
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
