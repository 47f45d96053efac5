"""Fragments of one peer -> complete messages, each once, within a memory cap.

Nothing is allocated from a number on the wire: fragments are stored by position, memory grows only by what arrived, and
the head's total is only compared. A refused fragment must not be acknowledged, so that it is retransmitted.
"""

from enum import Enum
from typing import NamedTuple

from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.memory_limit import PARTIAL_BYTES, Account, MemoryBudget
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead

FRAGMENT_OVERHEAD_BYTES = 120
"""Counted per fragment in addition to its bytes (dict entry, object headers), so that the cap covers tiny fragments
too."""

BEST_EFFORT_TIMEOUT_S = 2.0
"""A best-effort message is dropped after this long without a new fragment."""


RELIABLE_TIMEOUT_S = 300.0
"""A reliable message may wait this long behind more urgent ones. Then its memory is released, and if another fragment
arrives, the sender is asked to restart the message."""

NUMBERED_APART_FROM = 1 << 31
"""From here on broadcasts without repair are numbered, so that their losses leave no gaps among the others."""

MAX_EXPIRED_REMEMBERED = 1024
"""Expired messages of which further fragments are not acknowledged. Their sender gives each up within a second."""


class CompleteMessage(NamedTuple):
    """A complete message."""

    message_id: int
    head: MessageHead
    body: bytes


class FragmentStatus(Enum):
    """The result of a fragment that did not complete its message."""

    KEPT = 1
    DUPLICATE = 2
    """Already received, or of a finished message: acknowledge, deliver nothing."""
    FULL = 3
    """Out of memory: do not acknowledge."""
    TOO_LARGE = 4
    """The message is over the limit: refuse it."""
    CORRUPT = 5
    """It contradicts its head: refuse it."""
    FORGOTTEN = 6
    """Its earlier fragments were dropped: the sender must restart the message."""
    EXPIRED = 7
    """Its lifetime is over: its sender has already reported that and expects no acknowledgment."""


class _Partial:
    __slots__ = ("bytes", "expires_at", "head", "payloads", "seen", "touched_at")

    def __init__(self, now: float) -> None:
        self.payloads: dict[int, bytes] = {}
        self.head: MessageHead | None = None
        self.bytes = 0
        self.expires_at = float("inf")
        """When its sender gives it up, by our clock: never earlier than the sender does."""
        self.touched_at = now
        self.seen = 0
        """Fragments at the last `purge`."""


RESERVE_STEP_BYTES = 1 << 16
"""Reserved from the shared budget at a time, so that a single fragment costs only a comparison."""


class Reassembly:
    """`bytes` is the size of all unfinished messages, at most `Limits.partial_bytes_per_peer`."""

    __slots__ = (
        "_account",
        "_expired",
        "_limits",
        "_partials",
        "_reserved",
        "_unknown_to",
        "bytes",
        "finished",
        "forgotten",
    )

    def __init__(self, limits: Limits, account: Account | None = None) -> None:
        """`account` is this peer's share of the budget of all peers (None: unlimited)."""
        self._limits = limits
        self._account = account or Account(MemoryBudget(1 << 62))
        self._reserved = 0
        """What `bytes` may reach before more is reserved."""
        self._partials: dict[int, _Partial] = {}
        self.bytes = 0
        self.finished = RangeSet()
        self._unknown_to = [-1, -1]
        """Up to this number `finished` has numbers of which that is no longer known, below `NUMBERED_APART_FROM` and
        from there on: rather a message that old is sent again, and in the worst case twice, than taken for finished
        without having arrived."""
        self.forgotten = RangeSet()
        self._expired: dict[int, None] = {}
        """Those of `finished` that were dropped because their lifetime was over."""

    def __len__(self) -> int:
        return len(self._partials)

    def set_limits(self, limits: Limits) -> None:
        self._limits = limits

    def add(self, fragment: Fragment, now: float, late_s: float = 0.0) -> CompleteMessage | FragmentStatus:
        """Add one fragment that was delayed by `late_s`."""
        message_id, position, payload, head = fragment[:4]
        expires_at = float("inf")
        if head is not None and head.life_ms is not None:
            expires_at = now + head.life_ms / 1000 - late_s
            if expires_at <= now and message_id not in self.finished:
                return self._expire(message_id)
        partial = self._partials.get(message_id)
        if partial is None:
            if message_id in self._expired:
                # To acknowledge a copy of it would report it as delivered.
                return FragmentStatus.EXPIRED
            if message_id <= self._unknown_to[message_id >= NUMBERED_APART_FROM] or message_id in self.forgotten:
                return FragmentStatus.FORGOTTEN
            if message_id in self.finished:
                return FragmentStatus.DUPLICATE
            if head is not None:
                if head.size_bytes > self._limits.message_bytes:
                    return FragmentStatus.TOO_LARGE
                if head.fragments == 1:
                    self._finish(message_id)
                    return CompleteMessage(message_id, head, bytes(payload))
            if len(self._partials) >= self._limits.partials_per_peer or not self._account.has_room(PARTIAL_BYTES):
                return FragmentStatus.FULL
            partial = self._partials[message_id] = _Partial(now)
            self._account.reserve(PARTIAL_BYTES)
        payloads = partial.payloads
        if position in payloads:
            return FragmentStatus.DUPLICATE
        size = len(payload)
        if self.bytes + size + FRAGMENT_OVERHEAD_BYTES > self._reserved and not self._reserve(
            size + FRAGMENT_OVERHEAD_BYTES
        ):
            if not payloads:
                self.forget(message_id)
            return FragmentStatus.FULL
        known = partial.head
        if head is not None:
            if head.size_bytes > self._limits.message_bytes:
                self.forget(message_id)
                return FragmentStatus.TOO_LARGE
            known = partial.head = head
            partial.expires_at = expires_at
            if max(payloads, default=0) >= head.fragments:
                self.forget(message_id)
                return FragmentStatus.CORRUPT
        elif known is not None and position >= known.fragments:
            return FragmentStatus.CORRUPT
        payloads[position] = bytes(payload)
        partial.bytes += size
        self.bytes += size + FRAGMENT_OVERHEAD_BYTES
        if partial.bytes > (self._limits.message_bytes if known is None else known.size_bytes):
            self.forget(message_id)
            return FragmentStatus.CORRUPT
        if known is None or len(payloads) < known.fragments:
            return FragmentStatus.KEPT
        if partial.bytes != known.size_bytes:
            self.forget(message_id)
            return FragmentStatus.CORRUPT
        if partial.expires_at <= now:
            return self._expire(message_id)
        body = b"".join([payloads[place] for place in range(known.fragments)])
        self.forget(message_id)
        self._finish(message_id)
        return CompleteMessage(message_id, known, body)

    def add_plain(self, message_id: int, position: int, payload: bytes) -> bool:
        """The fast path of `add` for a new fragment in the middle of a known message. False if `add` must decide."""
        partial = self._partials.get(message_id)
        if partial is None or partial.head is None:
            return False
        payloads = partial.payloads
        size = len(payload)
        if (
            position in payloads
            or position >= partial.head.fragments
            or len(payloads) + 1 >= partial.head.fragments
            or self.bytes + size + FRAGMENT_OVERHEAD_BYTES > self._reserved
            or partial.bytes + size > partial.head.size_bytes
        ):
            return False
        payloads[position] = payload
        partial.bytes += size
        self.bytes += size + FRAGMENT_OVERHEAD_BYTES
        return True

    def forget(self, message_id: int) -> None:
        """Drop an unfinished message, if there is one."""
        partial = self._partials.pop(message_id, None)
        if partial is None:
            return
        self.bytes -= partial.bytes + FRAGMENT_OVERHEAD_BYTES * len(partial.payloads)
        self._account.release(PARTIAL_BYTES)
        spare = self._reserved - self.bytes
        if spare >= 2 * RESERVE_STEP_BYTES or not self.bytes:
            self._reserved = self.bytes
            self._account.release(spare)

    def _reserve(self, more: int) -> bool:
        """Whether `more` bytes may be held."""
        if self.bytes + more > self._limits.partial_bytes_per_peer:
            return False
        needed = self.bytes + more - self._reserved
        allowed = self._limits.partial_bytes_per_peer - self._reserved
        for size in (min(max(needed, RESERVE_STEP_BYTES), allowed), needed):
            if self._account.has_room(size):
                self._account.reserve(size)
                self._reserved += size
                return True
        return False

    def end(self, message_id: int) -> None:
        """End the message without delivering it (cancelled, refused): later fragments of it are duplicates."""
        self.forget(message_id)
        self._finish(message_id)

    def _expire(self, message_id: int) -> FragmentStatus:
        self.end(message_id)
        self._expired[message_id] = None
        if len(self._expired) > MAX_EXPIRED_REMEMBERED:
            del self._expired[next(iter(self._expired))]
        return FragmentStatus.EXPIRED

    def purge(self, now: float) -> None:
        """Drop messages that receive no more fragments."""
        for message_id, partial in list(self._partials.items()):
            if partial.seen != len(partial.payloads):
                partial.seen = len(partial.payloads)
                partial.touched_at = now
            idle_s = now - partial.touched_at
            if partial.expires_at <= now:
                self._expire(message_id)
            elif idle_s > RELIABLE_TIMEOUT_S:
                self.forget(message_id)
                self._remember(self.forgotten, message_id)
            elif (
                idle_s > BEST_EFFORT_TIMEOUT_S
                and partial.head is not None
                and not partial.head.flags & MessageFlag.RELIABLE
            ):
                self.end(message_id)

    def _finish(self, message_id: int) -> None:
        closed_to = self._remember(self.finished, message_id)
        if closed_to is not None:
            self._unknown_to[closed_to >= NUMBERED_APART_FROM] = closed_to

    def _remember(self, numbers: RangeSet, message_id: int) -> int | None:
        """Add a number. Returns the end of the gap that was closed for it, if that was necessary."""
        before = len(numbers)
        closed_to = None
        numbers.add(message_id)
        if len(numbers) > self._limits.finished_ranges_per_peer or self._account.too_many_ranges(len(numbers)):
            # Close the oldest gap: what could still fill it is older than thousands of finished messages.
            closed_to = numbers.fill_lowest_gap(NUMBERED_APART_FROM)
        if len(numbers) != before:
            self._account.count_ranges(len(numbers) - before)
        return closed_to
