"""A rate over the last second, computed from a running total."""


class Meter:
    """Call `feed` with running totals; `per_s` is the rate over the last complete period of about a second."""

    __slots__ = ("_at", "_rate", "_total")

    PERIOD_S = 1.0

    def __init__(self, now: float) -> None:
        self._at = now
        self._total = 0
        self._rate = 0.0

    def feed(self, total: int, now: float) -> None:
        """Record the running total at `now`. Call at least every second."""
        elapsed = now - self._at
        if elapsed >= self.PERIOD_S:
            self._rate = (total - self._total) / elapsed
            self._total = total
            self._at = now

    @property
    def total(self) -> int:
        """The running total of the last complete period."""
        return self._total

    def per_s(self, now: float) -> float:
        """Units per second; zero if nothing was fed for long."""
        return self._rate if now - self._at < 4 * self.PERIOD_S else 0.0
