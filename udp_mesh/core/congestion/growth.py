"""Growth of a window that is used up without a queue: the link has become faster, or a sample misled us.

`begin_round` is called once per round trip without a queue. Growth starts after a few of them, by little queue, and
doubles each round: a queue shows a round trip later, and on a long path a fixed factor would have added a quarter of
the round trip by then (measured at 600 ms: the p99 of urgent messages doubled). A link that delivers nothing more is
full.
"""

GROWTH = 1.25
"""Maximum growth per round trip."""

GROWTH_AFTER_ROUNDS = 3
"""Round trips without a queue before growth: two occur by chance near equilibrium."""

FIRST_GROWTH_S = 0.005
FIRST_GROWTH_ROUND_TRIPS = 1 / 60
"""The first step adds at most this much queue, the longer of both: on a long path each doubling takes long."""

FULL_GROWTH = 1.1
FULL_ROUNDS = 3
"""A link that delivers less than a tenth more after so many rounds of growth is full, whatever its delay."""

GROWTH_PAUSE_S = 2.0
"""How long to wait after that before growing again."""


class FullLink:
    """Whether growth still makes the link deliver more."""

    __slots__ = ("_capacity", "_rounds")

    def __init__(self) -> None:
        self._capacity = 0.0
        self._rounds = 0

    def restart(self, capacity: float) -> None:
        self._capacity, self._rounds = capacity, 0

    def is_full(self, capacity: float) -> bool:
        """Record a round of growth."""
        if capacity > FULL_GROWTH * self._capacity:
            self.restart(capacity)
        else:
            self._rounds += 1
        return self._rounds >= FULL_ROUNDS


class Growth:
    """`active` while the window runs ahead of the measured rate."""

    __slots__ = ("_empty_rounds", "_full", "_paused_until", "_step_s", "active")

    def __init__(self) -> None:
        self.active = False
        self._empty_rounds = 0
        self._step_s = 0.0
        self._full = FullLink()
        self._paused_until = 0.0

    def pause(self, until: float) -> None:
        """No growth before then."""
        self._paused_until = until

    def packets(self, cwnd: float, capacity: float, min_rtt: float, *, is_empty: bool, now: float) -> float | None:
        """The packets to add to the window in this round trip; None: it does not grow, 0: the link is full."""
        self._empty_rounds = self._empty_rounds + 1 if is_empty and now >= self._paused_until else 0
        if self._empty_rounds < GROWTH_AFTER_ROUNDS:
            self.active = False
            return None
        if not self.active:
            self._full.restart(capacity)
        elif self._full.is_full(capacity):
            self.active = False
            self._empty_rounds = 0
            self._paused_until = now + GROWTH_PAUSE_S
            return 0.0
        first_s = max(FIRST_GROWTH_S, FIRST_GROWTH_ROUND_TRIPS * min_rtt)
        self._step_s = 2 * self._step_s if self.active else first_s
        self.active = True
        return min((GROWTH - 1) * cwnd, max(1.0, self._step_s * capacity))
