"""A topic's rate limit as a token bucket: while it is empty, the topic's messages are parked."""

from udp_mesh.core.sender.scheduler import Run
from udp_mesh.core.sender.sender import Sender

BURST_S = 0.1
"""Capacity of the bucket: short enough to keep the limit over one second, long enough for a message."""


class TokenBucket:
    """One topic's bucket, shared by all destinations. It may go into debt by one `consume`."""

    __slots__ = ("_at", "_burst_s", "_bytes", "bytes_per_s", "parked")

    def __init__(self, bytes_per_s: int, now: float, *, burst_s: float = BURST_S) -> None:
        self.bytes_per_s = bytes_per_s
        self._burst_s = burst_s
        self._bytes = bytes_per_s * burst_s
        self._at = now
        self.parked: list[tuple[Sender, Run]] = []
        """What waits for tokens: messages, or single fragments to be retransmitted."""

    def has_tokens(self, now: float) -> bool:
        """Whether a datagram may be sent now."""
        self._bytes = min(self.bytes_per_s * self._burst_s, self._bytes + (now - self._at) * self.bytes_per_s)
        self._at = now
        return self._bytes > 0

    def consume(self, count: int) -> None:
        """Record that `count` bytes were sent."""
        self._bytes -= count

    def ready_at(self) -> float:
        """When the bucket is out of debt."""
        return self._at + max(0.0, 1.0 - self._bytes) / self.bytes_per_s

    def unpark(self) -> None:
        """Return everything parked to the front of its level, in order."""
        parked, self.parked = self.parked, []
        for sender, run in reversed(parked):
            if run.message.ended:
                continue
            if run.retransmit:
                sender.scheduler.push_retransmit(run.message, run.position)
            else:
                sender.scheduler.push(run.message, first=True)
