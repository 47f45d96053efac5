"""Pings of several sizes, sent together, while large datagrams are suspected to vanish: pongs in -> which sizes arrive.

A *comparison* is one ping for each MTU in question. The smallest is the control: once it is answered the path was up,
and a larger one sent at the same instant, in the same class of traffic, that is not answered soon afterwards was lost
because of its size, or by chance. This takes a round trip and some tenths of a second (RFC 8899's probe packets), where
data alone has to wait until late acknowledgments can be excluded.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

START_AFTER_S = 0.05
"""After the first sign. Where large datagrams are lost by chance, the next acknowledgment refutes it before that."""

INTERVAL_S = 0.05
LATER_INTERVAL_S = 0.25
FREQUENT_COMPARISONS = 20
"""Comparisons at the shorter interval; a path that loses most controls takes more."""

MAX_LINK_SHARE = 0.25
"""Maximum share of the link's capacity for comparisons: on slow links they are further apart."""

MAX_UNDECIDED = 6
"""Comparisons under way at once: on a long path more of them would prove nothing earlier."""

MIN_GRACE_S = 0.1
GRACE_ROUND_TRIPS = 0.5
"""A larger ping counts as lost if unanswered for both of these after the control's answer: links reorder."""

CONTROL_LOST_AFTER_S = 1.0
CONTROL_ROUND_TRIPS = 3.0

MIN_DECIDED = 4

MAX_CHANCE = 1e-3
"""Comparisons alone have to be this improbable by chance: the losses of data may have had another reason, such as
their priority."""

MAX_CONTROLS_LOST = 8
"""After so many lost controls in a row the path is down, which proves nothing; the next suspicion starts again."""

_INFINITY = float("inf")


@dataclass(slots=True)
class _Comparison:
    sent_at: float
    answered_at: float | None = None
    """When the control was answered."""
    answered: set[int] = field(default_factory=set)
    """MTUs whose pings were answered."""


class SizeComparisons:
    """The comparisons of one suspicion. `next_at`: when `settle` and `due` are to be called next."""

    __slots__ = (
        "_arriving",
        "_controls_lost",
        "_decided",
        "_lost_in_a_row",
        "_round_trip_s",
        "_send_at",
        "_tokens",
        "_undecided",
        "largest_mtu",
        "next_at",
        "sent",
    )

    def __init__(self) -> None:
        self.next_at = _INFINITY
        self._send_at = _INFINITY
        self._round_trip_s = 0.0
        """Of the last answered control."""
        self._tokens: dict[int, tuple[_Comparison, int, bool]] = {}
        """Token of a ping -> its comparison, its MTU, and whether it is the control."""
        self._undecided: list[_Comparison] = []
        self.largest_mtu = 0
        """The MTU in use, which the largest pings fill."""
        self.sent = self._decided = self._controls_lost = self._lost_in_a_row = 0
        self._arriving: set[int] = set()
        """MTUs of which a ping was answered."""

    @property
    def running(self) -> bool:
        return self.next_at != _INFINITY

    def start(self, now: float) -> None:
        """Compare soon, if that is not done already."""
        if not self.running:
            self._lost_in_a_row = 0
            self._send_at = self.next_at = now + START_AFTER_S

    def due(self, now: float) -> bool:
        """Whether to send a comparison now."""
        return now >= self._send_at and self._may_send()

    def _may_send(self) -> bool:
        return len(self._undecided) < MAX_UNDECIDED and self._lost_in_a_row < MAX_CONTROLS_LOST

    def on_sent(self, tokens: Mapping[int, int], now: float, packets_per_s: float | None) -> None:
        """Record the pings of a comparison: token -> MTU, the largest first. `packets_per_s`: the link's capacity."""
        comparison = _Comparison(now)
        self.largest_mtu, control = max(tokens.values()), min(tokens.values())
        for token, mtu in tokens.items():
            self._tokens[token] = comparison, mtu, mtu == control
        self._undecided.append(comparison)
        self.sent += 1
        interval_s = INTERVAL_S if self.sent < FREQUENT_COMPARISONS else LATER_INTERVAL_S
        if packets_per_s:
            interval_s = max(interval_s, len(tokens) / packets_per_s / MAX_LINK_SHARE)
        self._send_at = now + interval_s
        self._schedule()

    def on_pong(self, token: int, now: float) -> int | None:
        """The MTU that an answered ping fills; None if it is none of these pings."""
        found = self._tokens.pop(token, None)
        if found is None:
            return None
        comparison, mtu, control = found
        comparison.answered.add(mtu)
        self._arriving.add(mtu)
        if control and comparison.answered_at is None:
            self._round_trip_s = now - comparison.sent_at
            comparison.answered_at = now
            self._schedule()
        return mtu

    def settle(self, now: float) -> None:
        """Decide the comparisons whose time is up."""
        for comparison in list(self._undecided):
            if now < self._decided_at(comparison):
                continue
            self._undecided.remove(comparison)
            if comparison.answered_at is not None:
                self._decided += 1
                self._lost_in_a_row = 0
            elif not comparison.answered:
                self._controls_lost += 1
                self._lost_in_a_row += 1
        self._schedule()

    def _decided_at(self, comparison: _Comparison) -> float:
        if comparison.answered_at is not None:
            return comparison.answered_at + max(MIN_GRACE_S, GRACE_ROUND_TRIPS * self._round_trip_s)
        return comparison.sent_at + max(CONTROL_LOST_AFTER_S, CONTROL_ROUND_TRIPS * self._round_trip_s)

    def _schedule(self) -> None:
        self.next_at = min((self._decided_at(comparison) for comparison in self._undecided), default=_INFINITY)
        if self._may_send():
            self.next_at = min(self.next_at, self._send_at)

    def chance(self, loss: float) -> float:
        """Probability that every largest ping of the decided comparisons was lost by chance; `loss`: of small
        datagrams in one direction."""
        if self._decided < MIN_DECIDED:
            return 1.0
        both_ways = 1 - (1 - loss) ** 2
        unanswered = (self._controls_lost + 1) / (self._controls_lost + self._decided + 2)
        return float(max(both_ways, unanswered) ** self._decided)

    def largest_arriving(self) -> int:
        """The largest MTU whose ping was answered; 0 before the first answer."""
        return max(self._arriving, default=0)
