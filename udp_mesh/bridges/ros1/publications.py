"""Publishes into a ROS graph without ever waiting for its master.

rospy blocks a caller that advertises a topic until the master answers, as long as the master is down. So:

1. `publish` passes a message to its topic's publisher if one of the right type is ready; otherwise the message waits.
2. `run`, on a thread of its own, advertises the topics of waiting messages, first withdrawing the previous type.
3. The first messages of a new topic wait until the subscribers that existed before it have connected.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import Callable, Deque, NamedTuple, Protocol

from udp_mesh.bridges.types import TypeKey

FIRST_HOLD_S = 2.0
"""How long the first messages of a new topic wait for existing subscribers to connect."""
POLL_S = 0.05
"""Interval of polling for these connections."""
MAX_WAITING_MESSAGES, MAX_WAITING_BYTES = 1000, 16 << 20
"""Per topic, until it is advertised: seconds of telemetry or half a second of images; the oldest are dropped."""


class RosPublication(NamedTuple):
    """A message, with everything needed to advertise its topic."""

    name: str
    key: TypeKey
    definition: str
    latched: bool
    payload: bytes


class Advertised(Protocol):
    """One advertised topic. `publish` must not block."""

    def connections(self) -> int: ...

    def publish(self, payload: bytes) -> None: ...

    def withdraw(self) -> None: ...


class _Topic:
    """State of one name: its current advertisement and its waiting messages."""

    def __init__(self) -> None:
        self.advertised: Advertised | None = None
        self.kind: tuple[TypeKey, bool] | None = None
        self.subscribers = 0
        self.until = 0.0
        self.waiting: Deque[RosPublication] = deque()
        self.waiting_bytes = 0

    def matches(self, message: RosPublication) -> bool:
        return self.advertised is not None and self.kind == (message.key, message.latched)


class Publications:
    """All topics of one node. `advertise` and `subscribers_of` may block; only `run` calls them."""

    def __init__(
        self,
        advertise: Callable[[RosPublication], Advertised],
        subscribers_of: Callable[[str], int],
        clock: Callable[[], float],
    ) -> None:
        self._advertise = advertise
        self._subscribers_of = subscribers_of
        self._clock = clock
        self._topics: dict[str, _Topic] = {}
        self._changed = threading.Condition()
        self.dropped = 0
        """Messages dropped while they waited for the master."""

    def publish(self, message: RosPublication) -> None:
        """Publishes now, or once the topic is advertised; never blocks."""
        with self._changed:
            topic = self._topics.setdefault(message.name, _Topic())
            topic.waiting.append(message)
            topic.waiting_bytes += len(message.payload)
            self._flush(topic)
            while len(topic.waiting) > MAX_WAITING_MESSAGES or topic.waiting_bytes > MAX_WAITING_BYTES:
                topic.waiting_bytes -= len(topic.waiting.popleft().payload)
                self.dropped += 1
            if topic.waiting:
                self._changed.notify()

    def run(self, stop: threading.Event) -> None:
        """Advertises the topics of waiting messages, until `stop` is set."""
        while not stop.is_set():
            with self._changed:
                due = [topic for topic in self._topics.values() if topic.waiting]
                if not due:
                    # `stop` does not wake this wait, so it has a timeout.
                    self._changed.wait(1.0)
                    continue
            for topic in due:
                self._serve(topic)
            stop.wait(POLL_S)

    def _serve(self, topic: _Topic) -> None:
        with self._changed:
            self._flush(topic)
            if not topic.waiting or topic.matches(topic.waiting[0]):
                return
            first, last = topic.waiting[0], topic.advertised
            topic.advertised = None
        # Outside of the lock: the master may block these calls.
        if last is not None:
            # rospy keeps a topic's first type until its last publisher is gone.
            last.withdraw()
        subscribers = 0 if first.latched else self._subscribers_of(first.name)
        advertised = self._advertise(first)
        with self._changed:
            topic.advertised, topic.kind = advertised, (first.key, first.latched)
            topic.subscribers, topic.until = subscribers, self._clock() + FIRST_HOLD_S
            self._flush(topic)

    def _flush(self, topic: _Topic) -> None:
        """Publishes the waiting messages at the front that have the advertised type."""
        advertised = topic.advertised
        if advertised is None or not topic.waiting or not topic.matches(topic.waiting[0]):
            return
        if topic.subscribers and advertised.connections() < topic.subscribers and self._clock() < topic.until:
            return
        topic.subscribers = 0
        while topic.waiting and topic.matches(topic.waiting[0]):
            payload = topic.waiting.popleft().payload
            topic.waiting_bytes -= len(payload)
            advertised.publish(payload)

    def connections(self) -> dict[str, int]:
        """How many subscribers are connected to each advertised name."""
        with self._changed:
            topics = [(name, topic.advertised) for name, topic in self._topics.items()]
        return {name: advertised.connections() for name, advertised in topics if advertised is not None}

    def advertised(self) -> list[tuple[str, str]]:
        """Names and types registered with the master, or to be registered."""
        with self._changed:
            known = [(name, topic.kind) for name, topic in self._topics.items() if topic.advertised is not None]
        return [(name, kind[0].name) for name, kind in known if kind is not None]
