"""When a burst may leave to a silent peer that is heard: signs of life in -> whether a burst is worth it.

The first sign of life is answered at once. While nothing is acknowledged the next bursts wait, each twice as long as
the one before: the way there may be cut, or be one whose queue takes seconds, and more of the same would keep it full.
"""

RESUME_BURST_PACKETS = 10
"""What leaves at once when a silent peer is heard without acknowledging (the way to it may still be cut)."""

MIN_RESUME_INTERVAL_S = 0.1
MAX_RESUME_INTERVAL_S = 3.2


class ResumeBackoff:
    """Those of one silence after another."""

    __slots__ = ("_at", "_interval_s")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The silence is over."""
        self._at = float("-inf")
        self._interval_s = MIN_RESUME_INTERVAL_S

    def due(self, now: float) -> bool:
        """Whether one may leave now; it then counts as left."""
        if now < self._at:
            return False
        self._at = now + self._interval_s
        self._interval_s = min(MAX_RESUME_INTERVAL_S, 2 * self._interval_s)
        return True
