"""The node's event queue (bounded, in order) and its counters."""

from collections import deque

from udp_mesh.core.conditions import Counters
from udp_mesh.core.events import Event, MessageReceived


class EventQueue:
    """Events not fetched yet, and totals. If the driver stops reading, the oldest received messages are dropped, never
    outcomes."""

    __slots__ = ("_events", "_limit", "counters")

    def __init__(self, limit: int) -> None:
        self._events: deque[Event] = deque()
        self._limit = limit
        self.counters = Counters()

    def set_limit(self, limit: int) -> None:
        self._limit = limit

    def emit(self, event: Event) -> None:
        """Queue an event for the driver."""
        if len(self._events) >= self._limit:
            self._drop_one()
        self._events.append(event)

    @property
    def has_events(self) -> bool:
        """Whether an event waits to be fetched."""
        return bool(self._events)

    def next_event(self) -> Event | None:
        return self._events.popleft() if self._events else None

    def _drop_one(self) -> None:
        for place, event in enumerate(self._events):
            if isinstance(event, MessageReceived):
                del self._events[place]
                self.counters.events_dropped += 1
                return
