"""How many carried datagrams may be on their way to one neighbor, so that others wait here, in order of priority.

Once per round trip `w <- w/2 + (w * min_rtt / rtt + a) / 2`, where `a` is what the hop delivers in `QUEUE_S`; before
the first queue it doubles. Loss does not shrink it: the ends of the path retransmit. An acknowledgment covers all
up to its number, so that what was lost before it is not outstanding.
"""

from collections import deque

QUEUE_S = 0.006
"""Queue that bulk forms in the network of one hop."""
INITIAL_PACKETS = 32.0
MIN_PACKETS = 16.0
MAX_PACKETS = 2048.0
MIN_RTT_FOR_S = 10.0
"""A smallest round trip is believed for this long: routes of the radio mesh change."""
TIMEOUT_S = 0.25
"""Without an acknowledgment for this long (and four round trips) what is on its way counts as lost."""
SUSPECT_AFTER = 2
"""So many timeouts in a row: the neighbor no longer hears us."""


class HopWindow:
    """Times in seconds, packets by their number in the channel of the hop."""

    __slots__ = (
        "_delivered",
        "_doubling",
        "_min_rtt",
        "_min_rtt_at",
        "_progress_at",
        "_round_delivered",
        "_round_end",
        "_round_limited",
        "_round_started",
        "_sent",
        "packets",
        "rtt",
        "timeouts",
    )

    def __init__(self) -> None:
        self.packets = INITIAL_PACKETS
        self.rtt: float | None = None
        self.timeouts = 0
        """Consecutive ones, without an acknowledgment between them."""
        self._sent: deque[tuple[int, float]] = deque()
        self._min_rtt, self._min_rtt_at = float("inf"), 0.0
        self._doubling = True
        self._delivered = self._round_delivered = 0
        self._round_end = -1
        self._round_started = 0.0
        self._round_limited = False
        self._progress_at = 0.0

    @property
    def suspect(self) -> bool:
        return self.timeouts >= SUSPECT_AFTER

    @property
    def has_room(self) -> bool:
        """Whether a datagram that is not urgent may be sent."""
        if len(self._sent) < self.packets:
            return True
        self._round_limited = True
        return False

    def on_sent(self, number: int, now: float) -> None:
        if not self._sent:
            self._progress_at = now
        self._sent.append((number, now))

    def on_ack(self, largest: int, delay_s: float, now: float) -> None:
        sent_at: float | None = None
        while self._sent and self._sent[0][0] <= largest:
            sent_at = self._sent.popleft()[1]
            self._delivered += 1
        self._progress_at = now
        self.timeouts = 0
        if sent_at is None:
            return
        rtt = max(1e-5, now - sent_at - delay_s)
        self.rtt = rtt if self.rtt is None else self.rtt + (rtt - self.rtt) / 8
        if rtt <= self._min_rtt or now - self._min_rtt_at > MIN_RTT_FOR_S:
            self._min_rtt, self._min_rtt_at = rtt, now
        if largest >= self._round_end:
            self._next_round(largest, rtt, now)

    def _next_round(self, largest: int, rtt: float, now: float) -> None:
        """Adjust the window once per round trip, and only upward if it was what limited us."""
        elapsed = now - self._round_started
        delivered = self._delivered - self._round_delivered
        queue = QUEUE_S * delivered / elapsed if elapsed > 0 else MIN_PACKETS
        if self._doubling and rtt > self._min_rtt + QUEUE_S:
            self._doubling = False
        if self._doubling:
            target = 2 * self.packets
        else:
            target = self.packets / 2 + (self.packets * self._min_rtt / rtt + max(MIN_PACKETS, queue)) / 2
        if target < self.packets or self._round_limited:
            self.packets = min(MAX_PACKETS, max(MIN_PACKETS, target))
        self._round_started, self._round_delivered, self._round_limited = now, self._delivered, False
        self._round_end = self._sent[-1][0] if self._sent else largest + 1

    def timeout_at(self) -> float | None:
        """When what is on its way counts as lost."""
        if not self._sent:
            return None
        return self._progress_at + max(TIMEOUT_S, 4 * (self.rtt or 0.0))

    def on_timeout(self, now: float) -> None:
        self._sent.clear()
        self.timeouts += 1
        self.packets = max(MIN_PACKETS, self.packets / 2)
        self._progress_at = now
        self._round_end = -1
