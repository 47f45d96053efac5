"""Strict priority queueing for one peer: messages wait by level, and the most urgent fragment is chosen when a datagram
is built.

Within a level, retransmissions go first, then messages in the order accepted. After the peer was unresponsive,
`demote_stale` puts what waited on urgent levels behind new messages. On the other levels, where new messages may never
end, `alternate_stale` sends what waited for long and what is new in turn.
"""

from collections import deque
from typing import NamedTuple

from udp_mesh.core.sender.message import OutgoingMessage

SMALL_OVERHEAD_BYTES = 13
"""Approximate bytes of header of a small message in a datagram with others."""


MIN_PURGE_MESSAGES = 64
"""A level that holds this many messages, or twice as many as after the last time, forgets those that have ended: while
a peer cannot be sent anything, `keep_last` and deadlines end messages that nothing else takes out."""


class Run(NamedTuple):
    """Fragments of one message ready to send: `length` positions starting at `position`.

    `retransmit`: it was sent before. `stale`: it was demoted and is no longer treated as urgent.
    """

    message: OutgoingMessage
    position: int
    length: int
    retransmit: bool
    stale: bool = False


class _Level:
    __slots__ = (
        "alternates",
        "fresh",
        "fresh_bytes",
        "purge_at",
        "retransmit",
        "stale_fresh",
        "stale_next",
        "stale_retransmits",
    )

    def __init__(self) -> None:
        self.alternates = False
        """Stale and fresh messages are sent in turn, until one of them has run out."""
        self.stale_next = False
        self.purge_at = MIN_PURGE_MESSAGES
        """Length of `fresh` at which messages that have ended are forgotten."""
        self.fresh_bytes = 0
        """Bytes of the messages in `fresh`, with `SMALL_OVERHEAD_BYTES` each; approximate when some have ended."""
        self.retransmit: deque[tuple[OutgoingMessage, int]] = deque()
        self.fresh: deque[OutgoingMessage] = deque()
        self.stale_retransmits: deque[tuple[OutgoingMessage, int]] = deque()
        self.stale_fresh: deque[OutgoingMessage] = deque()

    def purge(self) -> None:
        """Forget messages that have ended."""
        self.fresh = deque(message for message in self.fresh if not message.ended)
        self.fresh_bytes = sum(len(message.body) + SMALL_OVERHEAD_BYTES for message in self.fresh)
        self.purge_at = max(MIN_PURGE_MESSAGES, 2 * len(self.fresh))

    def is_empty(self) -> bool:
        return not (self.retransmit or self.fresh or self.stale_retransmits or self.stale_fresh)


class _Levels(dict[int, _Level]):
    """By priority, created on first use: most peers use few levels, and a node may have a thousand peers."""

    def __missing__(self, priority: int) -> _Level:
        level = self[priority] = _Level()
        return level


class Scheduler:
    """`waiting` has bit p set while something waits on level p; the lowest bit is the most urgent."""

    __slots__ = ("_levels", "waiting")

    def __init__(self) -> None:
        self._levels = _Levels()
        self.waiting = 0

    def push(self, message: OutgoingMessage, *, first: bool = False) -> None:
        """Queue the unsent part of a message; `first` puts it at the front of its level."""
        level = self._levels[message.priority]
        if len(level.fresh) >= level.purge_at:
            level.purge()
        fresh = level.fresh
        level.fresh_bytes += len(message.body) + SMALL_OVERHEAD_BYTES
        if first:
            fresh.appendleft(message)
        else:
            fresh.append(message)
        self.waiting |= 1 << message.priority

    def restore(self, message: OutgoingMessage) -> None:
        """Queue a parked message again: in front of its level, but behind earlier messages of its topic."""
        level = self._levels[message.priority]
        place = 0
        for earlier in level.fresh:
            same = earlier.accepted.channel is message.accepted.channel
            if not same or earlier.accepted.message_id > message.accepted.message_id:
                break
            place += 1
        level.fresh.insert(place, message)
        level.fresh_bytes += len(message.body) + SMALL_OVERHEAD_BYTES
        self.waiting |= 1 << message.priority

    def push_retransmit(self, message: OutgoingMessage, position: int) -> None:
        """Queue a lost fragment for retransmission."""
        self._levels[message.priority].retransmit.append((message, position))
        self.waiting |= 1 << message.priority

    def is_idle(self, priority: int) -> bool:
        """Whether every level is empty. The bit of `priority`, the level just consumed from, may not be cleared yet."""
        return not self.waiting & ~(1 << priority) and self._levels[priority].is_empty()

    def peek(self, priority: int) -> Run | None:
        """The fragments to send next on this level. None, with the level's bit cleared, if it is empty."""
        level = self._levels[priority]
        if level.fresh and not level.retransmit and not level.stale_next:
            message = level.fresh[0]
            if message.wire_id is None and not message.ended:
                # The usual case of small messages, of which there may be thousands a second.
                return Run(message, 0, 1, False)
        queues = ((level.retransmit, level.fresh), (level.stale_retransmits, level.stale_fresh))
        for retransmit, fresh in reversed(queues) if level.stale_next else queues:
            while retransmit:
                message, position = retransmit[0]
                if message.ended or message.arrived[position]:
                    retransmit.popleft()
                    continue
                return Run(message, position, 1, retransmit=True, stale=fresh is level.stale_fresh)
            while fresh:
                message = fresh[0]
                left = message.fragments - message.next_position if message.started else 1
                if message.ended or left <= 0:
                    fresh.popleft()
                    continue
                return Run(message, message.next_position, left, retransmit=False, stale=fresh is level.stale_fresh)
        self.waiting &= ~(1 << priority)
        level.fresh_bytes = 0
        level.alternates = level.stale_next = False
        return None

    def fills(self, priority: int, room_bytes: int) -> bool:
        """Whether this level has enough for a datagram, or anything but fresh messages."""
        level = self._levels[priority]
        return level.fresh_bytes >= room_bytes or bool(level.retransmit or level.stale_retransmits or level.stale_fresh)

    def consume(self, run: Run, count: int) -> None:
        """Remove the first `count` fragments of the run just peeked."""
        level = self._levels[run.message.priority]
        if run.retransmit:
            (level.stale_retransmits if run.stale else level.retransmit).popleft()
            return
        message = run.message
        message.next_position += count
        if message.next_position >= message.fragments:
            self._pop(level, run)
            level.stale_next = level.alternates and not run.stale

    def park_head(self, run: Run) -> None:
        """Remove the message of the run just peeked (a rate limit parks it)."""
        level = self._levels[run.message.priority]
        if run.retransmit:
            (level.stale_retransmits if run.stale else level.retransmit).popleft()
        else:
            self._pop(level, run)

    def _pop(self, level: _Level, run: Run) -> None:
        if run.stale:
            level.stale_fresh.popleft()
        else:
            level.fresh_bytes -= len(run.message.body) + SMALL_OVERHEAD_BYTES
            level.fresh.popleft()

    def demote_stale(self, last_priority: int) -> None:
        """Mark what waits on levels up to `last_priority` as stale: new messages overtake it."""
        for priority, level in self._levels.items():
            if priority > last_priority:
                continue
            if level.retransmit:
                level.stale_retransmits.extend(level.retransmit)
                level.retransmit.clear()
            if level.fresh:
                level.stale_fresh.extend(level.fresh)
                level.fresh.clear()
                level.fresh_bytes = 0

    def alternate_stale(self, first_priority: int, queued_before: float) -> None:
        """From this level on, send what was queued before then and what was queued later in turn, a message each."""
        for priority, level in self._levels.items():
            if priority < first_priority:
                continue
            kept: deque[tuple[OutgoingMessage, int]] = deque()
            for entry in level.retransmit:
                (level.stale_retransmits if entry[0].queued_at < queued_before else kept).append(entry)
            level.retransmit = kept
            while level.fresh and level.fresh[0].queued_at < queued_before:
                message = level.fresh.popleft()
                level.fresh_bytes -= len(message.body) + SMALL_OVERHEAD_BYTES
                level.stale_fresh.append(message)
            level.alternates = bool(level.stale_fresh or level.stale_retransmits)

    def rebuild(self, messages: list[OutgoingMessage], *, keep_fragments: bool) -> None:
        """Rebuild the queues from these messages in this order; `keep_fragments` keeps queued retransmissions."""
        kept = []
        if keep_fragments:
            for _, level in sorted(self._levels.items()):
                kept.extend([*level.retransmit, *level.stale_retransmits])
        self._levels = _Levels()
        self.waiting = 0
        for message in messages:
            if not message.started or message.next_position < message.fragments:
                self.push(message)
        for message, position in kept:
            self.push_retransmit(message, position)
