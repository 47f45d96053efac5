"""Statistics of the messages pending for one peer, per priority level.

A message is added to its level when accepted, may move when its topic's priority changes, and is removed when it ends.
`record_served` notes which levels just sent: less urgent levels that wait meanwhile starve, and the statistics say for
how long.
"""

from collections import deque
from collections.abc import Iterable, Iterator

from udp_mesh.core.meter import Meter
from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.sender.send_memory import SendMemory
from udp_mesh.wire.limits import PRIORITY_LEVELS


class LevelStats:
    """The pending messages and starvation of one priority level."""

    __slots__ = (
        "bytes",
        "held_s",
        "messages",
        "order",
        "sent",
        "sent_bytes",
        "starved_reported",
        "starved_s",
        "starved_since",
    )

    def __init__(self) -> None:
        self.order: deque[OutgoingMessage] = deque()
        """Messages in the order accepted; ended ones are dropped from the front on access."""
        self.messages = 0
        self.bytes = 0
        self.starved_s = 0.0
        self.starved_since: float | None = None
        self.starved_reported = False
        self.held_s = 0.0
        self.sent_bytes = 0
        """Bytes of this level's datagrams, without IP and UDP headers."""
        self.sent: Meter | None = None
        """Their rate; None before the first."""

    def oldest(self) -> OutgoingMessage | None:
        order = self.order
        while order and order[0].ended:
            order.popleft()
        return order[0] if order else None


class PriorityLevels:
    """One `LevelStats` per priority. `queued_bytes` is the total pending on all levels; `memory` counts what is pending
    for all peers, this one's under the name `peer`."""

    __slots__ = ("_levels", "_memory", "_peer", "queued_bytes")

    def __init__(self, memory: SendMemory, peer: str) -> None:
        self._levels = [LevelStats() for _ in range(PRIORITY_LEVELS)]
        self._memory = memory
        self._peer = peer
        self.queued_bytes = 0

    def __getitem__(self, priority: int) -> LevelStats:
        return self._levels[priority]

    def __iter__(self) -> Iterator[LevelStats]:
        return iter(self._levels)

    def add(self, message: OutgoingMessage) -> None:
        """Count an accepted message."""
        level = self._levels[message.priority]
        size = message.queued_bytes
        level.messages += 1
        level.bytes += size
        self.queued_bytes += size
        self._memory.add(self._peer, message.accepted)
        self._append(level, message)

    def append(self, message: OutgoingMessage) -> None:
        """Append the message to its level (again, if it restarts as another object)."""
        self._append(self._levels[message.priority], message)

    def _append(self, level: LevelStats, message: OutgoingMessage) -> None:
        level.order.append(message)
        if len(level.order) > 64 + 2 * level.messages:
            level.order = deque(waiting for waiting in level.order if not waiting.ended)

    def remove(self, message: OutgoingMessage) -> None:
        """Stop counting a message that ended."""
        self._count(message, -1)
        self._memory.remove(self._peer, message.accepted)

    def _count(self, message: OutgoingMessage, sign: int) -> None:
        level = self._levels[message.priority]
        level.messages += sign
        level.bytes += sign * message.queued_bytes
        self.queued_bytes += sign * message.queued_bytes

    def reprioritize(self, messages: Iterable[OutgoingMessage]) -> bool:
        """Move each pending message (all of them, in the order accepted) to its topic's current priority. False if none
        moved."""
        everything = list(messages)
        if all(message.priority == message.accepted.channel.topic.priority for message in everything):
            return False
        for message in everything:
            priority = message.accepted.channel.topic.priority
            if priority != message.priority:
                self._count(message, -1)
                message.priority = priority
                self._count(message, 1)
        for priority, level in enumerate(self._levels):
            level.order = deque(message for message in everything if message.priority == priority)
        return True

    def record_sent(self, priority: int, sent_bytes: int, now: float) -> None:
        """Count the bytes of datagrams that a level just sent."""
        level = self._levels[priority]
        if level.sent is None:
            level.sent = Meter(now)
        level.sent_bytes += sent_bytes

    def measure(self, now: float) -> None:
        """Update the rates. Call at least every second."""
        for level in self._levels:
            if level.sent is not None:
                level.sent.feed(level.sent_bytes, now)

    def record_served(self, served: int, waiting: int, now: float) -> None:
        """Levels in the mask `served` sent something; less urgent ones in the mask `waiting` did not."""
        lowest = served & -served
        mask = waiting & ~(lowest - 1) | served
        while mask:
            bit = mask & -mask
            mask ^= bit
            level = self._levels[bit.bit_length() - 1]
            if bit & served:
                if level.starved_since is not None:
                    level.starved_s += now - level.starved_since
                    level.starved_since = None
                    level.starved_reported = False
            elif level.starved_since is None:
                level.starved_since = now

    def oldest_ages(self, last_priority: int, now: float) -> list[tuple[int, float]]:
        """(priority, age in s of the oldest pending message) of the levels up to `last_priority`."""
        ages = []
        for priority in range(last_priority + 1):
            level = self._levels[priority]
            oldest = level.oldest() if level.messages else None
            if oldest is not None:
                ages.append((priority, now - oldest.queued_at))
        return ages
