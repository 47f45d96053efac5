"""Foreign flows that fill the bottleneck's queue: what drains found -> whether to compete, and with what window.

A delay-based sender gives way to every queue, so that one TCP flow takes the whole link. The competitive mode is that
of Copa (Arun and Balakrishnan 2018), with our drains as its evidence:

1. A drain down to a few packets empties our own queue. If the round trip stays long, either the route became longer or
   others fill the queue. A route is as long the next time; a queue of others is not. A long round trip that differs
   from the one that a drain found turns the mode on.
2. In this mode the window grows and shrinks as TCP's: by `INCREASE` packets per round trip, and to `DECREASE` of it
   after losses while the queue is long. Losses at the rate known from before belong to the radio.
3. The first drain that finds the queue empty ends it, and so do several that find the same round trip: a longer route.

Nodes that report to send on the channel are no foreign flows (see `channel_share`): the mode stays off beside them.
"""

from collections import deque

BASE_VALID_S = 30.0
"""The shortest round trip of this time is that of the empty path: a TCP flow may leave no gap for seconds."""

FOREIGN_QUEUE_S = 0.008
FOREIGN_QUEUE_ROUND_TRIPS = 0.15
"""A round trip this much above the base shows a queue."""

VARIATION_S = 0.002
VARIATION = 0.03
"""Two drains on the same route differ by less than both together."""

SUSPECT_HOLDS = 2
"""A second drain follows soon after the first that found a long round trip. If it finds the same, a route is likely,
and each full drain of a long route is expensive: the others come at their usual time."""

ROUTE_HOLDS = 4
"""So many drains in a row that find the same round trip prove a route."""

INCREASE = 1.0
DECREASE = 0.7
"""TCP's additive increase, and the multiplicative decrease of CUBIC (RFC 9438, 4.6)."""

LONG_QUEUE = 0.6
"""Losses count while the queue is longer than this fraction of its recent maximum."""

RADIO_LOSS_GAIN = 1 / 64
"""Of the loss rate known from before: slow, because a flow that starts overruns the queue before a drain finds it."""

RADIO_LOSS_FACTOR = 2.0
"""Losses in one round trip beyond this multiple of the known loss rate are those of a full queue."""


class Competition:
    """Round trips in seconds, windows in packets."""

    __slots__ = ("_bases", "_holds", "_lost", "_max_rtt", "_radio_loss", "is_on")

    def __init__(self) -> None:
        self.is_on = False
        self._bases: deque[tuple[float, float]] = deque()
        self._holds: deque[float] = deque(maxlen=ROUTE_HOLDS)
        """What the last drains found, each of them a long round trip."""
        self._lost = 0
        self._max_rtt = 0.0
        self._radio_loss = 0.0

    @property
    def is_suspected(self) -> bool:
        """A drain found a long round trip, and the next one is to tell why."""
        return 0 < len(self._holds) < SUSPECT_HOLDS

    def base_rtt(self) -> float:
        return self._bases[0][1]

    def on_round(self, min_rtt: float, *, loss: float, now: float) -> None:
        """Record the minimum RTT of a round trip, and the loss rate."""
        if not self._holds:
            self._radio_loss += RADIO_LOSS_GAIN * (loss - self._radio_loss)
        bases = self._bases
        while bases and bases[-1][1] >= min_rtt:
            bases.pop()
        bases.append((now, min_rtt))
        while bases[0][0] < now - BASE_VALID_S:
            bases.popleft()
        if self._holds and not self.is_on and self._is_long(min_rtt):
            self._compare(min_rtt, now)

    def on_lost(self, count: int) -> None:
        self._lost += count

    def on_drained(self, rtt_s: float, *, others_send: bool, now: float) -> None:
        """Record the round trip found with next to nothing of ours in flight."""
        if others_send or not self._is_long(rtt_s):
            self.is_on = False
            self._holds.clear()
            return
        self._holds.append(rtt_s)
        self._compare(rtt_s, now)

    def _is_long(self, rtt_s: float) -> bool:
        base = self.base_rtt()
        return rtt_s > base + FOREIGN_QUEUE_S + FOREIGN_QUEUE_ROUND_TRIPS * base

    def _compare(self, rtt_s: float, now: float) -> None:
        holds = self._holds
        shortest = min(rtt_s, *holds)
        if max(holds) - shortest > VARIATION_S + VARIATION * shortest:
            if not self.is_on:
                self.is_on = True
                self._max_rtt = max(holds)
                self._lost = 0
        elif len(holds) == ROUTE_HOLDS:
            self._on_route(shortest, now)

    def _on_route(self, rtt_s: float, now: float) -> None:
        """Take a round trip for that of a longer route."""
        self.is_on = False
        self._holds.clear()
        self._bases.clear()
        self._bases.append((now, rtt_s))

    def window(self, cwnd: float, windowed_rtt: float) -> float:
        """The window after one more round trip."""
        lost, self._lost = self._lost, 0
        base = self.base_rtt()
        self._max_rtt = max(windowed_rtt, self._max_rtt - (self._max_rtt - base) / 256)
        is_long = windowed_rtt - base > LONG_QUEUE * (self._max_rtt - base)
        if is_long and lost > RADIO_LOSS_FACTOR * self._radio_loss * cwnd:
            return DECREASE * cwnd
        return cwnd + INCREASE
