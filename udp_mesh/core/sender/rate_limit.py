"""A topic's rate limit: bytes leave when the bucket holds them; until then the topic's messages are parked."""

from udp_mesh.core.sender.scheduler import Run
from udp_mesh.core.sender.sender import Sender

BURST_S = 0.1
"""The bucket holds this much time: short enough that a limit of one second's mean is kept, long enough for a
message."""


class TokenBucket:
    """One topic's bucket, shared by all destinations. It may go into debt by one datagram."""

    __slots__ = ("_at", "_bytes", "bytes_per_s", "parked")

    def __init__(self, bytes_per_s: int, now: float) -> None:
        self.bytes_per_s = bytes_per_s
        self._bytes = bytes_per_s * BURST_S
        self._at = now
        self.parked: list[tuple[Sender, Run]] = []
        """What waits for the bucket: messages, or single pieces to be sent again."""

    def has_tokens(self, now: float) -> bool:
        """Whether a datagram may leave now."""
        self._bytes = min(self.bytes_per_s * BURST_S, self._bytes + (now - self._at) * self.bytes_per_s)
        self._at = now
        return self._bytes > 0

    def consume(self, count: int) -> None:
        """`count` bytes left."""
        self._bytes -= count

    def ready_at(self) -> float:
        """When the bucket is out of debt."""
        return self._at + max(0.0, 1.0 - self._bytes) / self.bytes_per_s

    def unpark(self) -> None:
        """Put everything parked back in front of its level, in its order."""
        parked, self.parked = self.parked, []
        for sender, run in reversed(parked):
            if run.message.ended:
                continue
            if run.retransmit:
                sender.scheduler.push_retransmit(run.message, run.position)
            else:
                sender.scheduler.push(run.message, first=True)
