"""Path MTU black hole detection (RFC 8899): packets lost and acknowledged in -> a smaller path MTU.

A tunnel or mesh on the path may carry less than our own interface without reporting it. A datagram is large if the next
smaller MTU would not carry it.

1. A round ends when a small datagram arrives after large ones were lost, some time after the previous round.
2. From the first round on, pings of all sizes are compared (`size_comparison`).
3. The loss rate of small datagrams, measured meanwhile, gives the probability that the large ones were lost by chance.
   If it is negligible after some comparisons, or after several rounds without an arrival as large as the smallest loss,
   the MTU is reduced.
4. From then on pings of the larger size probe, ever less often, whether the path carries it after all.
"""

from collections.abc import Iterable, Sequence

from udp_mesh.core.sender.sent_packets import Packet
from udp_mesh.core.sender.size_comparison import MAX_CHANCE as MAX_COMPARISON_CHANCE
from udp_mesh.core.sender.size_comparison import SizeComparisons
from udp_mesh.wire.fragment import FRAGMENT_BYTES, HEAD_BYTES, LENGTH_BYTES

ETHERNET_MTU = 1500
"""RFC 894."""

NARROWER_MTUS = (ETHERNET_MTU, 1280, 576)
"""MTUs to try next, in bytes of IP packet: Ethernet, the IPv6 minimum (RFC 8200, 5), and what every IPv4 host accepts
(RFC 1122, 3.3.2)."""

ROUNDS = 4
ROUND_S = 0.3
LOST_PER_ROUND = 2
"""At least eight large datagrams within more than a second."""

MAX_CHANCE = 1e-6
"""At the loss rate of small datagrams, a run of large losses less likely than this is not chance."""

LOSS_SPACING_S = 0.1
"""Losses of large datagrams sent closer together count as one: what loses one of them often loses the others too."""

MAX_LARGE_LOST_BETWEEN = 8
"""Maximum large losses counted between two small arrivals, plus two per small loss: an outage loses both."""

MAX_SMALL_LOST_BETWEEN = 32
"""Maximum small losses counted between two arrivals: an outage adds no more however long it lasts."""

LOSS_MEMORY_PACKETS = 64
"""Small datagrams over which their loss rate is remembered between suspicions: of only a few, all may arrive by
chance."""

SUSPECT_S = 2.5
"""The minimum time from the first round without a large acknowledgment. If the round trip has just grown to a second
or two, acknowledgments are still on their way, and fragments cut again would arrive twice."""

PROBES_PER_SMALL = LOST_PER_ROUND + 1
"""Of the probes of an unresponsive peer, one in so many is small; a round uses the others."""

PROBE_AFTER_S = 10.0
MAX_PROBE_INTERVAL_S = 600.0
"""The larger size is first probed after the former time, which doubles up to the latter (RFC 8899's PMTU_RAISE_TIMER).
Until then a mistake costs a tenth of the rate; a path that is narrow costs three pings each time."""

MAX_PROBES = 3
"""Pings per attempt that would be answered at the current loss rate (RFC 8899's MAX_PROBES): one alone proves
little."""

MIN_ARRIVING = 0.3
"""Assumed minimum delivery rate of pings and of answers: at most 33 pings per attempt."""

INITIAL_LARGE_BYTES = 1200
"""Used until the path is first checked, for about half a second: roughly the frames that fit the IPv6 minimum MTU."""

_INFINITY = float("inf")


class PathMtu:
    """Path MTU state of one peer. `narrowed_at` is when the MTU was last reduced."""

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
        "comparisons",
        "large_bytes",
        "narrowed_at",
        "probe",
    )

    def __init__(self) -> None:
        self.large_bytes: float = INITIAL_LARGE_BYTES
        """Largest size of frames in a datagram that is not large; infinite if there is no smaller MTU to try."""
        self._large_lost = 0
        """Large datagrams lost in this round."""
        self._smallest_lost = _INFINITY
        """Frame size of the smallest large loss since the suspicion began."""
        self._rounds = 0
        self._round_at = 0.0
        self._suspect_since = 0.0
        self._large_lost_in_a_row = 0
        """Large datagrams lost since the suspicion began, not counting those sent close together."""
        self._counted_at = float("-inf")
        """When the last counted one was sent."""
        self._small = self._small_lost = 0
        """Small datagrams since the suspicion began."""
        self._large_lost_between = self._small_lost_between = 0
        """Large and small losses since a small datagram arrived."""
        self._past_small = self._past_small_lost = 0.0
        """Small datagrams of earlier suspicions."""
        self._probes = 0
        self.narrowed_at: float | None = None
        self.probe = PmtuProbe()
        self.comparisons = SizeComparisons()

    @property
    def suspect(self) -> bool:
        """Large datagrams were lost and none has arrived since."""
        return self._large_lost > 0 or self._rounds > 0

    # Detection

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
        """Record acknowledged packets while `suspect`; `called_lost` of them had been declared lost."""
        smallest = self._smallest_lost
        if any(_frames_bytes(packet) >= smallest for packet in packets):
            self.reset()
        else:
            self._on_small_acked(len(packets), called_lost, now)

    def next_probe_is_small(self) -> bool:
        """Whether the next probe of an unresponsive peer is small."""
        self._probes += 1
        return self.suspect and not self._probes % PROBES_PER_SMALL

    def on_small_probe_sent(self) -> None:
        """Count a small ping as lost until it is answered."""
        if self.suspect:
            self._on_small_lost()

    def on_pong(self, token: int, now: float) -> None:
        """Record the answer to a ping."""
        mtu = self.comparisons.on_pong(token, now)
        if mtu is not None:
            if mtu == self.comparisons.largest_mtu:
                self.reset()
        elif not self.probe.on_pong(token) and self.suspect:
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
            self.comparisons.start(now)

    def is_black_hole(self, now: float) -> bool:
        """Whether large datagrams do not get through."""
        if not self._rounds:
            return False
        small_loss = max(
            (self._small_lost + 1) / (self._small + 2),
            (self._past_small_lost + self._small_lost + 1) / (self._past_small + self._small + 2),
        )
        chance = small_loss**self._large_lost_in_a_row
        compared = self.comparisons.chance(small_loss)
        if compared < MAX_COMPARISON_CHANCE and chance * compared < MAX_CHANCE:
            return True
        return bool(chance < MAX_CHANCE and self._rounds >= ROUNDS and now - self._suspect_since >= SUSPECT_S)

    def reset(self) -> None:
        """Start over: a large datagram arrived, or the sizes changed."""
        self._past_small += self._small
        self._past_small_lost += self._small_lost
        if self._past_small > LOSS_MEMORY_PACKETS:
            self._past_small_lost *= LOSS_MEMORY_PACKETS / self._past_small
            self._past_small = LOSS_MEMORY_PACKETS
        self._large_lost = self._rounds = self._large_lost_in_a_row = self._small = self._small_lost = 0
        self._large_lost_between = self._small_lost_between = 0
        self._smallest_lost = _INFINITY
        if self.comparisons.running or self.comparisons.sent:
            self.comparisons = SizeComparisons()

    # Reduction

    def on_narrowed(self, now: float) -> None:
        """Record that the MTU was reduced."""
        self.reset()
        self.probe.start(now)
        self.narrowed_at = now


class PmtuProbe:
    """Schedules pings that probe a larger MTU and records the answers."""

    __slots__ = ("_interval_s", "_next_at", "_sent_probes", "_started_at", "_tokens", "confirmed_mtu")

    def __init__(self) -> None:
        self._started_at = float("-inf")
        self._next_at = float("inf")
        self._interval_s = PROBE_AFTER_S
        self._sent_probes = 0
        self._tokens: dict[int, int] = {}
        """Token of a ping that may still be answered -> the MTU it fills."""
        self.confirmed_mtu = 0
        """The largest MTU for which a ping was answered."""

    def start(self, now: float) -> None:
        """Start probing after a reduction. If the previous confirmation was recent, it proved little: probe less
        often."""
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
        """Whether to probe now. Call a few times a second, and only while the peer answers. `loss` is the loss rate
        toward the peer."""
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
        """Whether it was the answer to one of these pings."""
        mtu = self._tokens.pop(token, None)
        if mtu is not None:
            self.confirmed_mtu = max(self.confirmed_mtu, mtu)
        return mtu is not None


def _frames_bytes(packet: Packet) -> int:
    """Approximate size of the packet's frames, without topic announcements."""
    _, message, position, more = packet
    start, end = message.span(position)
    size = FRAGMENT_BYTES + end - start + (0 if position else HEAD_BYTES)
    for message, position in more:
        start, end = message.span(position)
        size += FRAGMENT_BYTES + LENGTH_BYTES + end - start + (0 if position else HEAD_BYTES)
    return size
