"""The interface of congestion controllers, and the fixed window.

The controller that follows the link is in `delay_based`.
"""

from typing import Protocol


class CongestionController(Protocol):
    """Decides how much may be in flight and how fast it is sent."""

    queue_share: float
    """Our fraction of a single sender's queue (see `channel_share`)."""

    @property
    def cwnd(self) -> float:
        """The congestion window in packets."""
        ...

    @property
    def undrained_cwnd(self) -> float:
        """The same as it was before a drain: the few urgent packets form no queue, so they need not wait for it."""
        ...

    def drain_overdue(self, now: float) -> bool:
        """Whether a drain takes longer than the packets in flight before it."""
        ...

    def pacing_packets_per_s(self) -> float | None:
        """The pacing rate (None: as fast as the window allows)."""
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
        lost: int,
        loss: float,
        now: float,
    ) -> None:
        """`count` packets were newly acknowledged, up to number `largest`; `rate` is a delivery rate sample. When the
        newest of them was sent, `ahead` others were in flight; `app_limited`: there was no more to send.
        `lost` packets were newly found lost; `loss` is the smoothed loss rate."""
        ...

    def capacity_packets_per_s(self) -> float | None:
        """The estimated capacity of the path."""
        ...

    def is_capacity_current(self, now: float) -> bool:
        """Whether the capacity was measured just now, not while more was sent earlier."""
        ...

    def assume_delivery(self) -> bool:
        """Whether the link can be assumed to keep delivering while acknowledgments are late, unless a queue that our
        window does not explain keeps it busy anyway."""
        ...

    def is_queue_explained(self) -> bool:
        """Whether the queue is no longer than our own window explains."""
        ...


class FixedWindow:
    """A constant window, as in the paper."""

    __slots__ = ("cwnd", "queue_share")

    def __init__(self, packets: int) -> None:
        self.cwnd = float(packets)
        self.queue_share = 1.0

    @property
    def undrained_cwnd(self) -> float:
        return self.cwnd

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
        lost: int,
        loss: float,
        now: float,
    ) -> None:
        return

    def capacity_packets_per_s(self) -> float | None:
        return None

    def is_capacity_current(self, now: float) -> bool:
        return False

    def assume_delivery(self) -> bool:
        return False

    def is_queue_explained(self) -> bool:
        return False
