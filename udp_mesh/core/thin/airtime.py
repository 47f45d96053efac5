"""The duty-cycle budget of one thin link: in every interval of `window_s` the node sends for at most its share.

Two token buckets, one for urgent frames alone. Together they hold at most `settings.BURST_SHARE` of what a window
allows and gain the rest of it in the course of a window, so that no interval of that length has more, wherever it
begins. They start empty: a process that crashes and starts again, however often, does not know what it has sent, and
cannot exceed the limit either.
"""

from __future__ import annotations

from udp_mesh.core.thin.settings import URGENT_SHARE, ThinLinkSettings

_ROUNDING_S = 1e-9


class AirtimeBudget:
    """`limit_s` in each window; times are the node's."""

    __slots__ = ("_general_s", "_limited", "_per_s", "_room_s", "_updated_at", "_urgent_s", "limit_s", "total_s")

    def __init__(self, settings: ThinLinkSettings, now: float) -> None:
        self.limit_s = settings.duty_cycle * settings.window_s
        self.total_s = 0.0
        """Airtime used since the start."""
        self._limited = settings.duty_cycle < 1
        self._room_s = settings.burst_s
        self._per_s = (self.limit_s - self._room_s) / settings.window_s
        self._urgent_s = self._general_s = 0.0
        self._updated_at = now

    @property
    def burst_s(self) -> float:
        """Airtime of the largest burst."""
        return self._room_s

    def available_s(self, now: float) -> float:
        """Airtime that an urgent frame may have now."""
        self._refill(now)
        return self._urgent_s + self._general_s

    def spend(self, airtime_s: float, now: float, *, urgent: bool) -> None:
        """A frame is being sent. Urgent ones use their own share first."""
        self._refill(now)
        self.total_s += airtime_s
        own_s = min(self._urgent_s, airtime_s) if urgent else 0.0
        self._urgent_s -= own_s
        self._general_s -= airtime_s - own_s
        # Nothing is gained while sending: else an interval that begins within a frame could have more.
        self._updated_at = max(self._updated_at, now + airtime_s)

    def ready_at(self, airtime_s: float, now: float, *, urgent: bool) -> float:
        """When a frame of this airtime may be sent, if nothing else is sent before; `now` if at once."""
        if not self._limited:
            return now
        self._refill(now)
        lacking_s = airtime_s - self._general_s - (self._urgent_s if urgent else 0.0)
        if lacking_s <= _ROUNDING_S:
            return now
        share = 1.0 if urgent else 1 - URGENT_SHARE
        return max(now, self._updated_at) + lacking_s / (share * self._per_s)

    def _refill(self, now: float) -> None:
        gained_s = max(0.0, now - self._updated_at) * self._per_s
        self._updated_at = max(self._updated_at, now)
        self._urgent_s = min(self._urgent_s + URGENT_SHARE * gained_s, URGENT_SHARE * self._room_s)
        self._general_s = min(self._general_s + (1 - URGENT_SHARE) * gained_s, (1 - URGENT_SHARE) * self._room_s)
