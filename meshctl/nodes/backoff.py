"""Exponential backoff for polling, with a time limit; Ctrl-C ends a pause."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

from meshctl.fleet import Interrupt

# A virtual or near node answers within the first pause.
FIRST_PAUSE_S, MAX_PAUSE_S, GROWTH = 0.2, 2.0, 1.5


@dataclass(slots=True)
class Backoff:
    """`pause` sleeps; `is_over` becomes true `limit_s` after creation."""

    limit_s: float
    interrupt: Interrupt
    _pause_s: float = FIRST_PAUSE_S
    _began: float = field(default_factory=time.monotonic)

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._began

    @property
    def left_s(self) -> float:
        return max(0.0, self.limit_s - self.elapsed_s)

    @property
    def is_over(self) -> bool:
        return self.elapsed_s >= self.limit_s

    def pause(self) -> None:
        """Sleep for the current pause, or until the second Ctrl-C."""
        self.interrupt.wait(min(self._pause_s, self.left_s))
        self._pause_s = min(self._pause_s * GROWTH, MAX_PAUSE_S)
