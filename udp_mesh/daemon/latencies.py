"""How long deliveries took, by priority: a histogram for Prometheus, which adds up over robots and time."""

from __future__ import annotations

import bisect
from collections.abc import Callable
from dataclasses import dataclass, field

from udp_mesh.core.events import Event, MessageDelivered
from udp_mesh.daemon.interface import RESERVED_PREFIX

BOUNDS_S = (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0, 300.0)
"""Upper bounds: an urgent message takes milliseconds, one that waited in an outbox minutes."""


@dataclass(slots=True)
class Histogram:
    """`counts` has one entry per bound and one for what is above the last; not cumulative."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    sum_s: float = 0.0

    def observe(self, seconds: float) -> None:
        self.counts[bisect.bisect_left(BOUNDS_S, seconds)] += 1
        self.sum_s += seconds


class Latencies:
    """Histograms by priority (`priority` gives a topic's) of the deliveries among the events that pass."""

    def __init__(self, priority: Callable[[str], int]) -> None:
        self.by_priority: dict[int, Histogram] = {}
        self._priority = priority

    def watching(self, on_event: Callable[[Event], None]) -> Callable[[Event], None]:
        """`on_event`, with deliveries counted first; the daemon's own topics do not count."""

        def observe(event: Event) -> None:
            if isinstance(event, MessageDelivered) and not event.topic.startswith(RESERVED_PREFIX):
                self.by_priority.setdefault(self._priority(event.topic), Histogram()).observe(event.latency_s)
            on_event(event)

        return observe
