"""What decides how many packets may be on their way to one peer: the seam, and the scheme that never decides anew.

The law that follows the link is in `adaptive`.
"""

from typing import Protocol


class CongestionController(Protocol):
    """Decides how much may be in flight and how fast it leaves."""

    queue_share: float
    """The part of a single sender's queue that is ours to keep (see `channel_share`)."""

    @property
    def cwnd(self) -> float:
        """How many packets may be on their way."""
        ...

    def drain_overdue(self, now: float) -> bool:
        """Whether a drain takes longer than what was on its way before it."""
        ...

    def pacing_packets_per_s(self) -> float | None:
        """Pacing (None: as fast as the window allows)."""
        ...

    def on_ack(
        self,
        count: int,
        largest: int,
        next_number: int,
        in_flight: int,
        rate: float | None,
        *,
        app_limited: bool,
        ahead: int,
        loss: float,
        now: float,
    ) -> None:
        """`count` packets were newly acknowledged, up to number `largest`; `rate` is a delivery rate sample.
        When the newest of them was sent, `ahead` others were in flight; `app_limited`: there was no more to send."""
        ...

    def capacity_packets_per_s(self) -> float | None:
        """Estimated packets/s of the path."""
        ...

    def assume_delivery(self) -> bool:
        """Whether the link can be presumed to go on delivering as it did while acknowledgements are late."""
        ...


class FixedWindow:
    """A number of packets, whatever happens: the paper's scheme."""

    __slots__ = ("cwnd", "queue_share")

    def __init__(self, packets: int) -> None:
        self.cwnd = float(packets)
        self.queue_share = 1.0

    def drain_overdue(self, now: float) -> bool:
        return False

    def pacing_packets_per_s(self) -> float | None:
        return None

    def on_ack(
        self,
        count: int,
        largest: int,
        next_number: int,
        in_flight: int,
        rate: float | None,
        *,
        app_limited: bool,
        ahead: int,
        loss: float,
        now: float,
    ) -> None:
        return

    def capacity_packets_per_s(self) -> float | None:
        return None

    def assume_delivery(self) -> bool:
        return False
