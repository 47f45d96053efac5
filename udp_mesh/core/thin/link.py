"""One thin link: what waits for it, and the frame that leaves next.

Frames are composed at the last moment: urgent parts, acknowledgments that are due, other parts by priority, then, if
there is room, acknowledgments and a presence that would be due soon anyway. A frame leaves when the one before is off
the air, random pauses keep nodes apart, and the duty-cycle budget has room for it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from udp_mesh.core.interfaces import RandomSource
from udp_mesh.core.thin.airtime import AirtimeBudget
from udp_mesh.core.thin.forgeries import ForgeryLimit
from udp_mesh.core.thin.outgoing import (
    MAX_URGENT_ATTEMPTS,
    UNHEARD_ATTEMPTS,
    LinkQueueEntry,
    ThinMessage,
)
from udp_mesh.core.thin.settings import ThinLinkSettings
from udp_mesh.wire.limits import MAX_THIN_HEARD
from udp_mesh.wire.thin import (
    HEARD_BYTES,
    INTRODUCTION_BYTES,
    PART_BYTES,
    THIN_OVERHEAD_BYTES,
    HeardFrom,
    ThinAck,
    ThinPresence,
    encode_item,
)

MAX_QUEUED = 64
"""Messages waiting for one link; the oldest of the least urgent ones makes room."""
MAX_ACKS = 64
SHORT_FRAME_BYTES = 20
"""About the size of an acknowledgment: pauses are counted in such frames."""
MAX_RETRY_S = 60.0
ANSWER_FRAMES = 4
"""Receivers of one message answer at random within the airtime of so many short frames for each of them."""
MAX_URGENT_DOUBLINGS = 1
"""An urgent message is sent again after at most twice the first pause."""
FIRST_PAUSE_FRAMES = 30
"""Airtime of so many short frames passes between the first two presences; each pause is twice the one before."""
BLOCKED_FRAMES = 8
"""Nodes whose budgets suffice again at one moment send within the airtime of so many short frames, or more."""
_NEVER = float("inf")


class ComposedFrame(NamedTuple):
    """A frame to seal."""

    items: bytes
    introduction: bool
    urgent: bool
    messages: tuple[ThinMessage, ...]
    """Those with parts in it."""


@dataclass(slots=True)
class PendingAck:
    """An acknowledgment to send, by `due_at` in a frame of its own."""

    due_at: float
    urgent: bool
    complete: bool


@dataclass(slots=True)
class ThinLinkCounters:
    """Counters of one link since the start."""

    frames_sent: int = 0
    bytes_sent: int = 0
    frames_received: int = 0
    frames_foreign: int = 0
    """Of other fleets, or of a boot whose introduction was not heard yet."""
    frames_unproven: int = 0
    """Authentic, but possibly recorded."""
    frames_replayed: int = 0
    frames_forged: int = 0
    frames_malformed: int = 0
    frames_rejected: int = 0
    """Not opened, because too many before were forged."""
    parts_sent: int = 0
    parts_repeated: int = 0
    messages_given_up: int = 0
    messages_dropped: int = 0
    """Because too many waited."""


@dataclass(slots=True, eq=False)
class ThinLink:
    """See the module's docstring. `node` is this node's name, `presence_s` its interval."""

    settings: ThinLinkSettings
    budget: AirtimeBudget
    rng: RandomSource
    node: str
    presence_s: float
    arrived: Callable[[int, int], int]
    """(sender's number, message) -> bits of the parts that are here."""
    counters: ThinLinkCounters = field(default_factory=ThinLinkCounters)
    forgeries: ForgeryLimit = field(default_factory=ForgeryLimit)
    queue: list[LinkQueueEntry] = field(default_factory=list)
    acks: dict[tuple[int, int], PendingAck] = field(default_factory=dict)
    presence_at: float = float("inf")
    pause_s: float = 0.0
    """Time until the next presence; short at first, so that a node that starts is known soon."""
    introduced_at: float = float("-inf")
    """When the last introduction was sent."""
    busy_until: float = 0.0
    blocked_until: float = 0.0
    """The budget has no room before."""
    up: bool = True
    _rotation: int = field(default=0, init=False)

    def short_s(self) -> float:
        """Airtime of a short frame."""
        return self.settings.airtime_s(SHORT_FRAME_BYTES)

    @property
    def part_bytes(self) -> int:
        """Payload of a part that fits a frame."""
        return self.settings.largest_frame_bytes - THIN_OVERHEAD_BYTES - PART_BYTES

    # What waits

    def push(self, message: ThinMessage) -> None:
        """Send this message once, and again as long as it is not acknowledged."""
        self.queue = [entry for entry in self.queue if not entry.message.ended]
        self.queue.append(LinkQueueEntry(message, deque(range(len(message.parts)))))
        if len(self.queue) > MAX_QUEUED:
            victim = max(self.queue, key=lambda entry: (entry.message.priority, -entry.message.accepted_at))
            self.queue.remove(victim)
            self.counters.messages_dropped += 1
        if message.urgent:
            self.blocked_until = 0.0

    def repeat(self, message: ThinMessage) -> None:
        """Send a message again, for a receiver that has just appeared."""
        for entry in self.queue:
            if entry.message is message:
                if not entry.to_send:
                    entry.repeat()
                break
        else:
            self.queue.append(LinkQueueEntry(message, deque(message.missing())))
        if message.urgent:
            self.blocked_until = 0.0

    def on_progress(self, message: ThinMessage, now: float) -> None:
        """A receiver reported which parts it lacks: send these now, and start again with the first pause."""
        for entry in self.queue:
            if entry.message is message and not entry.to_send:
                entry.attempts, entry.retry_at = 1, now

    def acknowledge(
        self, number: int, message: int, *, complete: bool, urgent: bool, within_s: float, now: float
    ) -> None:
        """Acknowledge a message, or its parts so far, after a random part of `within_s` or with an earlier frame."""
        due_at = now + within_s * self.rng.random()
        if not complete:
            # Once the sender pauses: the next part moves it.
            due_at += 2 * self.settings.airtime_s(self.settings.largest_frame_bytes)
        if (number, message) not in self.acks and len(self.acks) >= MAX_ACKS:
            return
        self.acks[number, message] = PendingAck(due_at, urgent, complete)
        if urgent:
            self.blocked_until = 0.0

    def introduce_soon(self, now: float, within_s: float) -> None:
        """Send an introduction after a random part of that time, if none is due before."""
        self.presence_at = min(self.presence_at, now + within_s * self.rng.random())

    def on_heard(self, now: float, *, more_follows: bool) -> None:
        """A frame has just ended on the channel: let others answer first, or its sender continue."""
        pause_s = self.short_s() * self.rng.random()
        if more_follows:
            pause_s += self.settings.airtime_s(self.settings.largest_frame_bytes)
        self.busy_until = max(self.busy_until, now + pause_s)

    # Times

    def next_at(self) -> float:
        """When `compose` may return a frame."""
        if not self.up:
            return _NEVER
        at = min((ack.due_at for ack in self.acks.values()), default=_NEVER)
        at = min(at, self.presence_at, min((entry.ready_at() for entry in self.queue), default=_NEVER))
        return max(at, self.busy_until, self.blocked_until)

    def expire(self, now: float) -> None:
        """Remove what has ended, and start the next attempt where one is due."""
        kept = []
        for entry in self.queue:
            message = entry.message
            if message.ended or now >= message.ends_at:
                continue
            if not entry.to_send and entry.retry_at <= now:
                if message.is_answered and not (message.is_for_strangers and entry.attempts < UNHEARD_ATTEMPTS):
                    continue
                if entry.attempts >= message.max_attempts:
                    self.counters.messages_given_up += bool(message.lacking)
                    continue
                entry.repeat()
            kept.append(entry)
        self.queue = kept

    # Frames

    def compose(self, heard: list[HeardFrom], now: float) -> ComposedFrame | None:
        """The frame to send now, if one is due and allowed. It counts as sent."""
        self.expire(now)
        if now < self.next_at():
            return None
        room = self.settings.largest_frame_bytes - THIN_OVERHEAD_BYTES
        ready = sorted(
            (entry for entry in self.queue if entry.to_send and entry.message.not_before <= now),
            key=lambda entry: (entry.message.priority, entry.message.accepted_at),
        )
        urgent = [entry for entry in ready if entry.message.urgent]
        presence_overdue = now - self.presence_at > self.presence_s / 2
        due = [key for key, ack in self.acks.items() if ack.due_at <= now]
        frame = _Composition(room)
        self._add_parts(frame, urgent)
        self._add_acks(frame, due)
        if presence_overdue and not urgent:
            self._add_presence(frame, heard)
        self._add_parts(frame, [entry for entry in ready if not entry.message.urgent])
        self._add_acks(frame, [key for key in self.acks if key not in due])
        if self.presence_at <= now or (frame.parts and (urgent or self.presence_at - now < self.presence_s / 2)):
            self._add_presence(frame, heard)
        if not frame.items:
            return None
        is_urgent = bool(urgent) or any(self.acks[key].urgent for key in frame.acks)
        size = len(frame.items) + THIN_OVERHEAD_BYTES + INTRODUCTION_BYTES * frame.introduction
        airtime_s = self.settings.airtime_s(size)
        self.blocked_until = self.budget.ready_at(airtime_s, now, urgent=is_urgent)
        if self.blocked_until > now:
            # At random: nodes that started together have equal budgets, and would collide each time these suffice.
            wait_s = 0.0 if is_urgent else self.blocked_until - now
            self.blocked_until += max(BLOCKED_FRAMES * self.short_s(), wait_s / 2) * self.rng.random()
            return None
        self.budget.spend(airtime_s, now, urgent=is_urgent)
        self._on_sent(frame, airtime_s, now)
        self.counters.frames_sent += 1
        self.counters.bytes_sent += size
        return ComposedFrame(
            bytes(frame.items), frame.introduction, is_urgent, tuple(entry.message for entry, _ in frame.parts)
        )

    def _add_parts(self, frame: _Composition, entries: list[LinkQueueEntry]) -> None:
        for entry in entries:
            for index in entry.to_send:
                if not frame.add(encode_item(entry.message.part(index))):
                    # The rest of a message does not overtake it.
                    return
                frame.parts.append((entry, index))

    def _add_acks(self, frame: _Composition, keys: list[tuple[int, int]]) -> None:
        for key in keys:
            number, message = key
            parts = None if self.acks[key].complete else self.arrived(number, message)
            if frame.add(encode_item(ThinAck(number, message, parts))):
                frame.acks.append(key)

    def _add_presence(self, frame: _Composition, heard: list[HeardFrom]) -> None:
        if frame.introduction:
            return
        interval_s = min(255, round(1.5 * self.presence_s + 0.5))
        bare = encode_item(ThinPresence(self.node, interval_s))
        room = frame.room - INTRODUCTION_BYTES - len(bare)
        if room < min(len(heard), 1) * HEARD_BYTES:
            return
        count = min(len(heard), room // HEARD_BYTES, MAX_THIN_HEARD)
        start = self._rotation % len(heard) if count < len(heard) else 0
        frame.heard = count
        frame.room -= INTRODUCTION_BYTES
        frame.introduction = True
        frame.add(encode_item(ThinPresence(self.node, interval_s, tuple((heard + heard)[start : start + count]))))

    def _on_sent(self, frame: _Composition, airtime_s: float, now: float) -> None:
        self.busy_until = now + airtime_s + self.short_s() * (0.5 + self.rng.random())
        for entry, index in frame.parts:
            entry.to_send.remove(index)
            self.counters.parts_sent += 1
            self.counters.parts_repeated += entry.attempts > 0
            if not entry.to_send:
                self._on_pass_sent(entry, now + airtime_s)
        for key in frame.acks:
            del self.acks[key]
        if frame.introduction:
            self._rotation += frame.heard
            self.introduced_at = now
            self.pause_s = min(2 * self.pause_s or FIRST_PAUSE_FRAMES * self.short_s(), self.presence_s)
            self.presence_at = now + self.pause_s * (0.5 + self.rng.random())

    def _on_pass_sent(self, entry: LinkQueueEntry, now: float) -> None:
        entry.attempts += 1
        if not entry.message.reliable and not entry.message.urgent:
            entry.attempts = MAX_URGENT_ATTEMPTS
            entry.retry_at = now
            return
        receivers = max(1, len(entry.message.lacking))
        answer_s = ANSWER_FRAMES * (receivers + 1) * self.short_s() + 2 * self.settings.airtime_s(
            self.settings.largest_frame_bytes
        )
        if entry.message.urgent and entry.attempts == 1:
            # Twice before it listens: on a lossy channel many receivers would lack the first copy.
            entry.retry_at = now + self.short_s() * (1 + self.rng.random())
            return
        doublings = min(entry.attempts - 2, MAX_URGENT_DOUBLINGS) if entry.message.urgent else entry.attempts - 1
        pause_s = answer_s * 2**doublings * (1 + 0.5 * self.rng.random())
        entry.retry_at = now + min(pause_s, MAX_RETRY_S)


@dataclass(slots=True)
class _Composition:
    """A frame being composed; `room` is what its items may still have."""

    room: int
    items: bytearray = field(default_factory=bytearray)
    parts: list[tuple[LinkQueueEntry, int]] = field(default_factory=list)
    acks: list[tuple[int, int]] = field(default_factory=list)
    introduction: bool = False
    heard: int = 0

    def add(self, item: bytes) -> bool:
        """Whether there was room."""
        if len(item) > self.room:
            return False
        self.room -= len(item)
        self.items += item
        return True
