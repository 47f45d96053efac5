"""Packets acknowledged and lost in -> the share that is lost, and whether that calls for redundant copies."""

LOSS_MEMORY_PACKETS = 256
"""Packets over which loss is smoothed."""


class LossEstimate:
    """The loss toward one peer."""

    __slots__ = ("rate", "send_twice")

    def __init__(self) -> None:
        self.rate = 0.0
        """Share of packets lost, smoothed."""
        self.send_twice = False
        """Loss was seen recently: small urgent messages are sent twice."""

    def add(self, lost: int, total: int, twice_loss: float) -> None:
        """Of `total` packets that were decided, `lost` were lost. From `twice_loss` on, messages are sent twice, until
        the loss is below a quarter of it."""
        if not total:
            return
        if self.rate >= twice_loss:
            self.send_twice = True
        elif self.rate < twice_loss / 4:
            self.send_twice = False
        self.rate += (lost - self.rate * total) / max(total, LOSS_MEMORY_PACKETS)
