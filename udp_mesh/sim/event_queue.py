"""Virtual time: actions in order of time, then in order of insertion."""

from __future__ import annotations

import heapq
from collections.abc import Callable


class SimEventQueue:
    """`now` advances only in `run_until`; everything simulated shares one queue."""

    def __init__(self) -> None:
        self.now = 0.0
        self._entries: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def at(self, time_s: float, action: Callable[[], None]) -> None:
        """Schedules `action` at `time_s`, or now if that has passed."""
        self._count += 1
        heapq.heappush(self._entries, (max(time_s, self.now), self._count, action))

    def after(self, delay_s: float, action: Callable[[], None]) -> None:
        self.at(self.now + delay_s, action)

    def run_until(self, time_s: float) -> None:
        """Runs everything due up to and at `time_s`, then sets `now` to `time_s`."""
        while self.step(time_s):
            pass

    def step(self, time_s: float) -> bool:
        """Runs the next action due up to `time_s`; if there is none, sets `now` to `time_s` and returns False."""
        if not self._entries or self._entries[0][0] > time_s:
            self.now = time_s
            return False
        self.now, _, action = heapq.heappop(self._entries)
        action()
        return True
