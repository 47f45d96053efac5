"""Messages to all in one datagram: sealed once for everyone, sent on every link, and repaired where their topic says
so.

Sending: a cast waits on its priority level and leaves between the peers' pieces of that level; small urgent ones leave
twice once loss is seen. Casts with repair are numbered 0, 1, 2, ... and kept for a while; the others are numbered
apart. Receiving: a gap in the numbers (or a heartbeat that counts further) is asked for with a Nack after a short
random wait, again a few times, and answered per peer, or with a Cancel where it is no longer kept.
"""

from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import replace

from udp_mesh.core.interfaces import Datagram, RandomSource
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.settings import Address
from udp_mesh.crypto import SHORT_OVERHEAD_BYTES, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, Frame, MessageFlag, MessageHead, Nack, Sent, TopicAnnounce
from udp_mesh.wire.limits import PRIORITY_LEVELS

FIRST_UNREPAIRED_NUMBER = 1 << 31
"""Numbers of casts without repair start here, so that a lost one leaves no gap among those with repair."""

NACK_DELAY_S = 0.02
"""Between noticing a gap and asking: a reordered cast still comes, and not everyone asks at once."""

NACK_INTERVAL_S = 0.25
"""Between two requests for one cast: a round trip and a resend, generously."""

MAX_NACKS = 8

MAX_MISSING = 256
"""Casts asked for at a time per peer: a sender that jumps ahead must not make us ask for millions."""


class BroadcastQueue:
    """Casts waiting to leave, by level; `waiting` as in `Scheduler`."""

    __slots__ = (
        "_copies",
        "_levels",
        "_number",
        "_repairable",
        "_repairable_bytes",
        "_unrepaired",
        "free_at",
        "waiting",
    )

    def __init__(self) -> None:
        self._levels: list[deque[AcceptedMessage]] = [deque() for _ in range(PRIORITY_LEVELS)]
        self._copies: deque[tuple[float, list[Datagram]]] = deque()
        self._repairable: OrderedDict[int, AcceptedMessage] = OrderedDict()
        self._repairable_bytes = 0
        self._number = 0
        self._unrepaired = 0
        self.waiting = 0
        self.free_at = 0.0

    @property
    def next_number(self) -> int:
        """Of the next cast with repair."""
        return self._number

    @property
    def kept_bytes(self) -> int:
        return self._repairable_bytes

    def push(self, accepted: AcceptedMessage) -> None:
        topic = accepted.channel.topic
        level = self._levels[topic.priority]
        if topic.keep_last is not None:
            same = [waiting for waiting in level if waiting.channel.topic.name == topic.name]
            for old in same[: max(0, len(same) + 1 - topic.keep_last)]:
                level.remove(old)
        level.append(accepted)
        self.waiting |= 1 << topic.priority

    def reprioritize(self) -> None:
        """Topics changed their priorities: what waits moves to its new level."""
        waiting = [accepted for level in self._levels for accepted in level]
        for level in self._levels:
            level.clear()
        self.waiting = 0
        for accepted in waiting:
            self._levels[accepted.channel.topic.priority].append(accepted)
            self.waiting |= 1 << accepted.channel.topic.priority

    def queued(self) -> int:
        """Casts that have not left."""
        return sum(len(level) for level in self._levels)

    def send_level(
        self,
        priority: int,
        channel: SendChannel,
        paths: Iterable[tuple[str, Address | None]],
        now: float,
        out: list[Datagram],
        *,
        packets_per_s: float | None,
        copy_after_s: float | None,
        repairable_limit_bytes: int,
        max_timestamped_bytes: int,
    ) -> None:
        """Let the casts of a level leave on all `paths` (link, address); `copy_after_s` sends them a second time
        then. Those of at
        most `max_timestamped_bytes` say when they left."""
        level = self._levels[priority]
        paths = list(paths)
        while level:
            if packets_per_s is not None:
                if self.free_at > now:
                    return
                self.free_at = max(self.free_at, now - 0.003) + 1 / packets_per_s
            accepted = level.popleft()
            if accepted.deadline is not None and accepted.deadline <= now:
                continue
            frames = self._frames(accepted, now, repairable_limit_bytes)
            encoded = encode(_with_timestamp(frames, accepted, now))
            if len(encoded) + SHORT_OVERHEAD_BYTES > max_timestamped_bytes:
                encoded = encode(frames)
            _, data = channel.seal(encoded)
            urgent = packets_per_s is None
            datagrams = [Datagram(link, address, data, urgent) for link, address in paths]
            out.extend(datagrams)
            if copy_after_s is not None:
                # The same packet number: whoever has it drops the copy before deciphering it.
                self._copies.append((now + copy_after_s, datagrams))
        self.waiting &= ~(1 << priority)

    def send_copies(self, now: float, out: list[Datagram]) -> None:
        while self._copies and self._copies[0][0] <= now:
            out.extend(self._copies.popleft()[1])

    def next_at(self) -> float:
        """When something wants to leave that could not yet."""
        at = self._copies[0][0] if self._copies else float("inf")
        return min(at, self.free_at) if self.waiting else at

    def repair(self, number: int) -> AcceptedMessage | None:
        """The cast of this number, if still kept."""
        return self._repairable.get(number)

    def _frames(self, accepted: AcceptedMessage, now: float, limit_bytes: int) -> tuple[TopicAnnounce, Fragment]:
        channel = accepted.channel
        flags = accepted.flags | MessageFlag.TO_ALL
        if channel.topic.repair:
            number = self._number
            self._number += 1
            flags |= MessageFlag.REPAIR
            self._repairable[number] = accepted
            self._repairable_bytes += len(accepted.body)
            while self._repairable_bytes > limit_bytes:
                self._repairable_bytes -= len(self._repairable.popitem(last=False)[1].body)
        else:
            number = FIRST_UNREPAIRED_NUMBER + self._unrepaired % FIRST_UNREPAIRED_NUMBER
            self._unrepaired += 1
        age_ms = max(0, int((now - accepted.accepted_at) * 1000))
        head = MessageHead(len(accepted.body), 1, channel.number, channel.topic.priority, flags, age_ms)
        return (
            TopicAnnounce(channel.number, channel.name, channel.type_name),
            Fragment(number, 0, accepted.body, head),
        )


def _with_timestamp(frames: tuple[TopicAnnounce, Fragment], accepted: AcceptedMessage, now: float) -> list[Frame]:
    """The same, with the time and what remains of the message's life."""
    announce, fragment = frames
    assert fragment.head is not None
    head = replace(fragment.head, life_ms=accepted.life_ms(now))
    return [Sent(clock_ms(now)), announce, fragment._replace(head=head)]


class NackRepair:
    """Which casts of one peer are missing here, and when to ask for them."""

    __slots__ = ("_expected", "_missing", "_rng", "next_at")

    def __init__(self, rng: RandomSource) -> None:
        self._rng = rng
        self._expected: int | None = None
        """All numbers below were received, are missing, or were given up."""
        self._missing: dict[int, tuple[float, int]] = {}
        """Number -> (when to ask, how often asked)."""
        self.next_at = float("inf")

    def on_counter(self, next_number: int, now: float, received: RangeSet) -> None:
        """A heartbeat counts casts up to `next_number`: those not here are missing."""
        if self._expected is None:
            # Casts from before we met are not for us.
            self._expected = next_number
            return
        if next_number <= self._expected:
            return
        for number in range(max(self._expected, next_number - MAX_MISSING), next_number):
            if number not in received:
                at = now + NACK_DELAY_S * (0.5 + self._rng.random())
                self._missing[number] = (at, 0)
                self.next_at = min(self.next_at, at)
        self._expected = next_number

    def on_received(self, number: int, now: float, received: RangeSet) -> None:
        """A cast with repair arrived."""
        self._missing.pop(number, None)
        if self._expected is None:
            self._expected = number
        if number >= self._expected:
            self.on_counter(number, now, received)
            self._expected = number + 1

    def abandon(self, number: int) -> None:
        """The sender no longer has it."""
        self._missing.pop(number, None)

    def due_nacks(self, now: float) -> list[Nack]:
        """What to ask for now."""
        nacks = []
        for number, (at, times) in list(self._missing.items()):
            if at > now:
                continue
            if times >= MAX_NACKS:
                del self._missing[number]
                continue
            nacks.append(Nack(number))
            self._missing[number] = (now + NACK_INTERVAL_S, times + 1)
        self.next_at = min((at for at, _ in self._missing.values()), default=float("inf"))
        return nacks
