"""Priority backoff between nodes: while urgent levels wait elsewhere, less urgent levels are held back here.

Each node reports in heartbeats and acknowledgments which urgent levels wait at it, and for how long. Nodes that hear
this hold back their own less urgent levels for `yield_hold_s`, but never for more than `yield_share` of the time, so
that none starves.
"""

from collections.abc import Iterable

from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender
from udp_mesh.core.settings import Rates
from udp_mesh.wire.frames import Waiting

ALL_LEVELS = 0xFFFF

BUDGET_S = 1.0
"""Period of the hold-back budget."""

CHECK_INTERVAL_S = 0.02
"""Minimum time between two checks of the local queues."""


class PriorityBackoff:
    """`allowed_levels(now)` is the bit mask of levels that may be sent."""

    __slots__ = ("_allowed", "_budget_at", "_budget_s", "_checked_at", "_rates", "_until", "_waiting", "held_total_s")

    def __init__(self, rates: Rates, now: float) -> None:
        self._rates = rates
        self._allowed = ALL_LEVELS
        self._until = float("-inf")
        self._budget_s = BUDGET_S * rates.yield_share
        self._budget_at = now
        self._checked_at = float("-inf")
        self._waiting: tuple[Waiting, ...] = ()
        self.held_total_s = 0.0

    def apply(self, rates: Rates) -> None:
        self._rates = rates

    def local_waiting(self, senders: Iterable[Sender], now: float) -> tuple[Waiting, ...]:
        """The urgent levels with a message that has waited too long, most urgent first."""
        if now < self._checked_at + CHECK_INTERVAL_S:
            return self._waiting
        self._checked_at = now
        oldest: dict[int, float] = {}
        for sender in senders:
            if sender.state is SendState.UNRESPONSIVE:
                # Messages to an unresponsive peer do not wait for other nodes' airtime.
                continue
            max_wait_s = self._rates.yield_after_s + 3 * (sender.rtt.min_rtt or 0.0)
            for priority, age_s in sender.levels.oldest_ages(self._rates.urgent_priority, now):
                if age_s > max_wait_s:
                    oldest[priority] = max(age_s, oldest.get(priority, 0.0))
        self._waiting = tuple(
            Waiting(priority, min(65_535, int(age_s * 1000))) for priority, age_s in sorted(oldest.items())
        )
        return self._waiting

    def on_waiting(self, waiting: tuple[Waiting, ...], now: float) -> None:
        """Process another node's waiting levels."""
        level = min(entry.priority for entry in waiting)
        if level > self._rates.urgent_priority or self._rates.yield_share <= 0:
            return
        share = self._rates.yield_share
        self._budget_s = min(BUDGET_S * share, self._budget_s + (now - self._budget_at) * share)
        self._budget_at = now
        extension = now + self._rates.yield_hold_s - max(now, self._until)
        if extension <= 0 or self._budget_s < extension:
            return
        allowed = (1 << (level + 1)) - 1
        self._allowed = allowed if now >= self._until else min(self._allowed, allowed)
        self._budget_s -= extension
        self.held_total_s += extension
        self._until = now + self._rates.yield_hold_s

    def allowed_levels(self, now: float) -> int:
        return self._allowed if now < self._until else ALL_LEVELS

    def held_until(self, now: float) -> float | None:
        return self._until if now < self._until else None
