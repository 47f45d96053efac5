"""Strict priority to one peer: messages wait by level, and the most urgent piece is chosen when a datagram leaves.

Within a level pieces to be sent again go first, then messages in the order accepted. After a silence of the peer the
urgent levels put what waited then behind what comes fresh (`demote_stale`): nothing stale stands ahead of fresh.
"""

from collections import deque
from typing import NamedTuple

from udp_mesh.core.sender.message import OutgoingMessage


class Run(NamedTuple):
    """Pieces of one message ready to leave: `length` positions from `position` on.

    `retransmit`: it left before. `stale`: it was set aside and has no claim to be urgent any more.
    """

    message: OutgoingMessage
    position: int
    length: int
    retransmit: bool
    stale: bool = False


class _Level:
    __slots__ = ("fresh", "retransmit", "stale_fresh", "stale_retransmits")

    def __init__(self) -> None:
        self.retransmit: deque[tuple[OutgoingMessage, int]] = deque()
        self.fresh: deque[OutgoingMessage] = deque()
        self.stale_retransmits: deque[tuple[OutgoingMessage, int]] = deque()
        self.stale_fresh: deque[OutgoingMessage] = deque()

    def empty(self) -> bool:
        return not (self.retransmit or self.fresh or self.stale_retransmits or self.stale_fresh)


class _Levels(dict[int, _Level]):
    """By priority, made when first used: most peers use few levels, and a node may have a thousand peers."""

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
        """All of the message (what of it has not left) waits; `first` puts it ahead of its level."""
        fresh = self._levels[message.priority].fresh
        if first:
            fresh.appendleft(message)
        else:
            fresh.append(message)
        self.waiting |= 1 << message.priority

    def push_retransmit(self, message: OutgoingMessage, position: int) -> None:
        """One piece of the message was lost and waits anew."""
        self._levels[message.priority].retransmit.append((message, position))
        self.waiting |= 1 << message.priority

    def is_idle(self, priority: int) -> bool:
        """Whether every level is empty; `priority` is the one just taken from, whose bit may not show it yet."""
        return not self.waiting & ~(1 << priority) and self._levels[priority].empty()

    def peek(self, priority: int) -> Run | None:
        """What leaves next on this level; None (and the level's bit cleared) when nothing does."""
        level = self._levels[priority]
        for retransmit, fresh in ((level.retransmit, level.fresh), (level.stale_retransmits, level.stale_fresh)):
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
        return None

    def consume(self, run: Run, count: int) -> None:
        """The first `count` pieces of the run just peeked leave."""
        level = self._levels[run.message.priority]
        if run.retransmit:
            (level.retransmit or level.stale_retransmits).popleft()
            return
        message = run.message
        message.next_position += count
        if message.next_position >= message.fragments:
            (level.fresh if level.fresh and level.fresh[0] is message else level.stale_fresh).popleft()

    def park_head(self, run: Run) -> None:
        """The message of the run just peeked leaves this scheduler whole (a rate limit parks it)."""
        level = self._levels[run.message.priority]
        if run.retransmit:
            (level.retransmit or level.stale_retransmits).popleft()
        elif level.fresh and level.fresh[0] is run.message:
            level.fresh.popleft()
        else:
            level.stale_fresh.popleft()

    def demote_stale(self, last_priority: int) -> None:
        """What waits on levels up to `last_priority` is stale from now on: fresh messages overtake it."""
        for priority, level in self._levels.items():
            if priority > last_priority:
                continue
            if level.retransmit:
                level.stale_retransmits.extend(level.retransmit)
                level.retransmit.clear()
            if level.fresh:
                level.stale_fresh.extend(level.fresh)
                level.fresh.clear()

    def rebuild(self, messages: list[OutgoingMessage], *, keep_fragments: bool) -> None:
        """Start anew with these messages in this order; with `keep_fragments`, pieces that wait to be sent again keep
        waiting."""
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
