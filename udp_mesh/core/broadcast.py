"""Broadcast messages: sealed once, sent on every link in one datagram, and repaired if their topic says so.

Sending: a broadcast waits on its priority level and is sent between the peers' fragments of that level; small urgent
ones are sent twice once loss is seen. Broadcasts with repair are numbered 0, 1, 2, ... and kept for a while; the others
are numbered separately. Receiving: after a short random delay a gap in the numbers (or a heartbeat that counts further)
is requested with a Nack, a few times. The answer is a unicast copy, or a Cancel if it is no longer kept.
"""

from collections import OrderedDict, deque
from collections.abc import Iterable

from udp_mesh.core.interfaces import Datagram, RandomSource
from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.receiver.reassembly import NUMBERED_APART_FROM
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.settings import Address
from udp_mesh.crypto import SHORT_OVERHEAD_BYTES, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, Frame, MessageFlag, MessageHead, Nack, Sent, TopicAnnounce
from udp_mesh.wire.limits import PRIORITY_LEVELS

FIRST_UNREPAIRED_NUMBER = NUMBERED_APART_FROM
"""First number of broadcasts without repair, so that losing one leaves no gap among those with repair."""

NACK_DELAY_S = 0.02
"""Delay from noticing a gap to the Nack: a reordered broadcast still arrives, and not all receivers ask at once."""

NACK_INTERVAL_S = 0.25
"""Between two Nacks for one broadcast: generously a round trip and a retransmission."""

MAX_NACKS = 8

MAX_MISSING = 256
"""Broadcasts requested at a time per peer: a sender whose numbers jump ahead must not cause millions of requests."""


class BroadcastQueue:
    """Broadcasts waiting to be sent, by level; `waiting` as in `Scheduler`."""

    __slots__ = (
        "_copies",
        "_levels",
        "_number",
        "_repairable",
        "_repairable_bytes",
        "_unrepaired",
        "free_at",
        "held",
        "held_until",
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
        self.held = 0
        """Mask of the levels that are held back for other nodes' urgent messages until `held_until`."""
        self.held_until = 0.0

    @property
    def next_number(self) -> int:
        """Number of the next broadcast with repair."""
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
        """Move waiting broadcasts to their topics' new levels."""
        waiting = [accepted for level in self._levels for accepted in level]
        for level in self._levels:
            level.clear()
        self.waiting = 0
        for accepted in waiting:
            self._levels[accepted.channel.topic.priority].append(accepted)
            self.waiting |= 1 << accepted.channel.topic.priority

    def queued(self) -> int:
        """Broadcasts not sent yet."""
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
        """Send the broadcasts of a level on all `paths` (link, address); `copy_after_s` sends them once more after that
        time. Those of at most `max_timestamped_bytes` carry a timestamp."""
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
                # The copy has the same packet number: nodes that have it drop the copy before decrypting it.
                self._copies.append((now + copy_after_s, datagrams))
        self.waiting &= ~(1 << priority)

    def send_copies(self, now: float, out: list[Datagram]) -> None:
        while self._copies and self._copies[0][0] <= now:
            out.extend(self._copies.popleft()[1])

    def next_at(self) -> float:
        """When something can be sent that could not be sent yet."""
        at = self._copies[0][0] if self._copies else float("inf")
        if self.waiting & ~self.held:
            return min(at, self.free_at)
        return min(at, max(self.free_at, self.held_until)) if self.waiting else at

    def repair(self, number: int) -> AcceptedMessage | None:
        """The broadcast with this number, if still kept."""
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
    """The frames with a timestamp and the message's remaining lifetime."""
    announce, fragment = frames
    assert fragment.head is not None
    head = fragment.head._replace(life_ms=accepted.life_ms(now))
    return [Sent(clock_ms(now)), announce, fragment._replace(head=head)]


class NackRepair:
    """The broadcasts of one peer that are missing here, and when to request them."""

    __slots__ = ("_expected", "_missing", "_rng", "next_at")

    def __init__(self, rng: RandomSource) -> None:
        self._rng = rng
        self._expected: int | None = None
        """All lower numbers were received, are missing, or were abandoned."""
        self._missing: dict[int, tuple[float, int]] = {}
        """Number -> (when to request it, how often it was requested)."""
        self.next_at = float("inf")

    def on_counter(self, next_number: int, now: float, received: RangeSet) -> None:
        """Process a heartbeat's counter: broadcasts below `next_number` that are not here are missing."""
        if self._expected is None:
            # Broadcasts from before we met are not for us.
            self._expected = next_number
            return
        if next_number <= self._expected:
            return
        for number in range(max(self._expected, next_number - MAX_MISSING), next_number):
            if number not in received:
                at = now + NACK_DELAY_S * (0.5 + self._rng.random())
                self._missing[number] = (at, 0)
                self.next_at = min(self.next_at, at)
        while len(self._missing) > MAX_MISSING:
            del self._missing[next(iter(self._missing))]
        self._expected = next_number

    def on_received(self, number: int, now: float, received: RangeSet) -> None:
        """Record the arrival of a broadcast with repair."""
        self._missing.pop(number, None)
        if self._expected is None:
            self._expected = number
        if number >= self._expected:
            self.on_counter(number, now, received)
            self._expected = number + 1

    def abandon(self, number: int) -> None:
        """Stop requesting a broadcast that the sender no longer keeps."""
        self._missing.pop(number, None)

    def due_nacks(self, now: float) -> list[Nack]:
        """The Nacks to send now."""
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
