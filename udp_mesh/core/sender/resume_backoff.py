"""Limits bursts to an unresponsive peer that is heard but acknowledges nothing.

The first sign of life triggers a burst at once. While nothing is acknowledged, the interval to the next burst doubles:
the forward path may be down, or have a queue of seconds that more bursts would keep full.
"""

STALE_AFTER_S = 1.0
"""After an outage, messages that are not urgent and have waited longer than this share their level with new ones."""

FAST_PROBE_FOR_S = 1.0

RESUME_BURST_PACKETS = 10
"""Packets sent at once when an unresponsive peer is heard without acknowledging (the path to it may still be down)."""

MIN_RESUME_INTERVAL_S = 0.1
MAX_RESUME_INTERVAL_S = 3.2


class ResumeBackoff:
    """The burst interval while a peer is unresponsive."""

    __slots__ = ("_at", "_interval_s")

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The peer responds again."""
        self._at = float("-inf")
        self._interval_s = MIN_RESUME_INTERVAL_S

    def due(self, now: float) -> bool:
        """Whether a burst may be sent now; it then counts as sent."""
        if now < self._at:
            return False
        self._at = now + self._interval_s
        self._interval_s = min(MAX_RESUME_INTERVAL_S, 2 * self._interval_s)
        return True
