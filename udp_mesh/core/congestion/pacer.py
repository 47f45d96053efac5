"""Pacing: when the next packets may be sent, in quanta of a few milliseconds.

A quantum of packets is sent together, then a timer waits for the next: fewer wake-ups than one per packet, and segments
that offload can batch.
"""

MAX_DEBT_S = 0.25
"""Bursts beyond the pace (to an unresponsive peer), or packets sent at the pace of a path that was slow then, delay
later packets by no more than this, or than one packet takes now: the window limits what is in flight, pacing only
spreads it."""


class Pacer:
    """`free_at` is when the next packet may be sent; up to a quantum of unused time is caught up."""

    __slots__ = ("_quantum_s", "free_at")

    def __init__(self, quantum_s: float) -> None:
        self._quantum_s = quantum_s
        self.free_at = 0.0

    def packets_allowed(self, now: float, packets_per_s: float | None) -> int:
        """How many packets may be sent now."""
        if packets_per_s is None:
            return 1 << 30
        start = self.free_at = min(self.free_at, now + max(MAX_DEBT_S, 1.0 / packets_per_s))
        if start > now:
            return 0
        start = max(start, now - self._quantum_s)
        return int((now - start) * packets_per_s) + 1

    def on_sent(self, count: int, now: float, packets_per_s: float | None) -> None:
        """Record that `count` packets were sent."""
        if packets_per_s is not None:
            self.free_at = max(self.free_at, now - self._quantum_s) + count / packets_per_s

    def wake_at(self, packets_per_s: float | None) -> float:
        """When a quantum of packets (at least one) may be sent."""
        if packets_per_s is None:
            return self.free_at
        return self.free_at + max(0.0, self._quantum_s - 1.0 / packets_per_s)
