"""Whether to wake for every datagram or once per tick: wake-ups and what they carried in, the answer out. Pure.

A radio at 10 Mbit/s brings one datagram per millisecond, the pacing lets a few leave every three, acknowledgements
come in between: each wake-up costs more than it carries. Then one look at everything per `TICK_S` halves the
processor's share, for a few milliseconds of delay. Where wake-ups are few, or bring many datagrams (a wire), there is
nothing to gain.
"""

from __future__ import annotations

TICK_S = 0.003
"""Between two looks: the core's pacing quantum."""
WINDOW_S = 0.05
"""How long wake-ups are counted before the answer may change."""
BUSY_WAKEUPS = 12
"""So many in a window (240 a second) cost more than ticks would."""
FULL_BATCH = 24
"""Datagrams per wake-up from which it is worth its cost."""
IDLE_TICKS = 5
"""So many ticks in a row without a datagram end the ticking."""


class Rhythm:
    """Told of every wake-up; `ticking` is the answer."""

    def __init__(self) -> None:
        self.ticking = False
        self._since = 0.0
        self._wakeups = 0
        self._datagrams = 0
        self._idle = 0

    def woke(self, now: float, datagrams: int) -> bool:
        """One wake-up at `now` that moved so many datagrams in and out; True where the answer has changed."""
        if self.ticking:
            self._idle = 0 if datagrams else self._idle + 1
            if self._idle < IDLE_TICKS and datagrams < FULL_BATCH:
                return False
            self.ticking = False
            self._restart(now)
            return True
        self._wakeups += 1
        self._datagrams += datagrams
        if now - self._since < WINDOW_S:
            return False
        busy = self._wakeups >= BUSY_WAKEUPS and now - self._since < 2 * WINDOW_S
        self.ticking = busy and self._datagrams < FULL_BATCH * self._wakeups
        self._restart(now)
        return self.ticking

    def _restart(self, now: float) -> None:
        self._since, self._wakeups, self._datagrams, self._idle = now, 0, 0, 0
