"""Bounds what a tag of 4 bytes can be attacked with: after `MAX_FAILURES` frames of a link that could not be
authenticated within `PERIOD_S`, the link accepts nothing for the rest of that period.

One forged frame in 2**32 passes. With 256 attempts an hour, a year of constant attack succeeds with a probability of
256 * 24 * 365 / 2**32 = 0.05 %. The price: anyone who can send on the channel can silence it, like a jammer.
"""

from __future__ import annotations

MAX_FAILURES = 256
PERIOD_S = 3600.0


class ForgeryLimit:
    """Failures of one link in the current period."""

    __slots__ = ("_period_ends_at", "failures", "total")

    def __init__(self) -> None:
        self.failures = 0
        self.total = 0
        self._period_ends_at = float("-inf")

    def rejects(self, now: float) -> bool:
        """Whether the link accepts nothing now."""
        if now >= self._period_ends_at:
            self.failures = 0
        return self.failures >= MAX_FAILURES

    def on_failure(self, now: float) -> bool:
        """Count a frame that could not be authenticated. True for the one that closes the link."""
        if now >= self._period_ends_at:
            self._period_ends_at = now + PERIOD_S
            self.failures = 0
        self.failures += 1
        self.total += 1
        return self.failures == MAX_FAILURES

    def ends_in_s(self, now: float) -> float:
        """Time until the period ends."""
        return max(0.0, self._period_ends_at - now)
