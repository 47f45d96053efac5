"""The capacity of the path: delivery rate samples in -> their windowed maximum out."""

from collections import deque

RATE_WINDOW_S = 2.0
"""How long a delivery rate sample is valid."""


class DeliveryRate:
    """Packets per second. `maximum` is the capacity of the path; None before the first sample."""

    __slots__ = ("_samples", "maximum")

    def __init__(self) -> None:
        self._samples: deque[tuple[float, float]] = deque()
        self.maximum: float | None = None

    def is_current(self, now: float) -> bool:
        """Whether the maximum is a sample within the window: of an application-limited sender the last one stays."""
        return bool(self._samples) and self._samples[0][0] >= now - RATE_WINDOW_S

    def add(self, rate: float, *, app_limited: bool, now: float) -> None:
        """Add a sample; an application-limited one counts only if it is larger."""
        samples = self._samples
        while samples and samples[0][0] < now - RATE_WINDOW_S and not (app_limited and len(samples) == 1):
            samples.popleft()
        if not app_limited or (samples and rate >= samples[0][1]):
            while samples and samples[-1][1] <= rate:
                samples.pop()
            samples.append((now, rate))
        self.maximum = samples[0][1] if samples else None

    def clear(self) -> None:
        self._samples.clear()
        self.maximum = None
