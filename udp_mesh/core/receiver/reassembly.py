"""Pieces of messages of one peer -> whole messages, each once, within a memory cap.

Nothing is allocated from a number on the wire: a piece is kept under its position, memory grows only by what arrived,
and the head's total is a number to compare with. A piece that is refused must not be acknowledged, so that it comes
again.
"""

from enum import Enum
from typing import NamedTuple

from udp_mesh.core.ranges import RangeSet
from udp_mesh.core.receiver.memory_limit import PARTIAL_BYTES, Account, MemoryBudget
from udp_mesh.core.settings import Limits
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead

FRAGMENT_OVERHEAD_BYTES = 120
"""Counted per piece besides its bytes (dict entry, object headers), so that tiny pieces meet the cap too."""

BEST_EFFORT_TIMEOUT_S = 2.0
"""A best-effort message whose pieces stop for this long will not be completed."""


RELIABLE_TIMEOUT_S = 300.0
"""A reliable message may wait this long behind more urgent ones; then its memory is taken back and, if a piece still
comes, the sender told to begin anew."""


class CompleteMessage(NamedTuple):
    """A complete message."""

    message_id: int
    head: MessageHead
    body: bytes


class FragmentStatus(Enum):
    """What became of a piece that did not complete its message."""

    KEPT = 1
    DUPLICATE = 2
    """Already here, or of a finished message: acknowledge, deliver nothing."""
    FULL = 3
    """No memory now: do not acknowledge."""
    TOO_LARGE = 4
    """The message can never be taken: refuse it."""
    CORRUPT = 5
    """It contradicts its head: refuse it."""
    FORGOTTEN = 6
    """Its earlier pieces were given up: it must be sent anew."""
    EXPIRED = 7
    """Its life is over: its sender has reported so, and expects no acknowledgement."""


class _Partial:
    __slots__ = ("bytes", "expires_at", "head", "payloads", "seen", "touched_at")

    def __init__(self, now: float) -> None:
        self.payloads: dict[int, bytes] = {}
        self.head: MessageHead | None = None
        self.bytes = 0
        self.expires_at = float("inf")
        """When its sender gives it up, by our clock: not before the sender does."""
        self.touched_at = now
        self.seen = 0
        """Pieces at the last `purge`."""


RESERVE_STEP_BYTES = 1 << 16
"""Taken from the memory of all peers at a time: a piece alone costs no more than a comparison."""


class Reassembly:
    """`bytes` is what all unfinished messages hold, at most `Limits.partial_bytes_per_peer`."""

    __slots__ = ("_account", "_limits", "_partials", "_reserved", "bytes", "finished", "forgotten")

    def __init__(self, limits: Limits, account: Account | None = None) -> None:
        """`account` is what this peer holds of the memory of all (None: there is no such bound)."""
        self._limits = limits
        self._account = account or Account(MemoryBudget(1 << 62))
        self._reserved = 0
        """What `bytes` may reach before more is taken from the account."""
        self._partials: dict[int, _Partial] = {}
        self.bytes = 0
        self.finished = RangeSet()
        self.forgotten = RangeSet()

    def __len__(self) -> int:
        return len(self._partials)

    def set_limits(self, limits: Limits) -> None:
        self._limits = limits

    def add(self, fragment: Fragment, now: float, late_s: float = 0.0) -> CompleteMessage | FragmentStatus:
        """Take in one piece, `late_s` longer on its way than others."""
        message_id, position, payload, head = fragment[:4]
        expires_at = float("inf")
        if head is not None and head.life_ms is not None:
            expires_at = now + head.life_ms / 1000 - late_s
            if expires_at <= now and message_id not in self.finished:
                self.end(message_id)
                return FragmentStatus.EXPIRED
        partial = self._partials.get(message_id)
        if partial is None:
            if message_id in self.finished:
                return FragmentStatus.DUPLICATE
            if message_id in self.forgotten:
                return FragmentStatus.FORGOTTEN
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
            partial.expires_at = min(partial.expires_at, expires_at)
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
            self.end(message_id)
            return FragmentStatus.EXPIRED
        body = b"".join([payloads[place] for place in range(known.fragments)])
        self.forget(message_id)
        self._finish(message_id)
        return CompleteMessage(message_id, known, body)

    def add_plain(self, message_id: int, position: int, payload: bytes) -> bool:
        """The fast path of `add` for a new piece in the middle of a known message; False where `add` must decide."""
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

    def forget(self, message_id: int) -> bool:
        """Drop what is here of an unfinished message; False if nothing was."""
        partial = self._partials.pop(message_id, None)
        if partial is None:
            return False
        self.bytes -= partial.bytes + FRAGMENT_OVERHEAD_BYTES * len(partial.payloads)
        self._account.release(PARTIAL_BYTES)
        spare = self._reserved - self.bytes
        if spare >= 2 * RESERVE_STEP_BYTES or not self.bytes:
            self._reserved = self.bytes
            self._account.release(spare)
        return True

    def _reserve(self, more: int) -> bool:
        """Whether so many bytes more may be held."""
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
        """The message is over without being delivered (cancelled, refused): later pieces of it are duplicates."""
        self.forget(message_id)
        self._finish(message_id)

    def purge(self, now: float) -> None:
        """Drop messages whose pieces stopped coming."""
        for message_id, partial in list(self._partials.items()):
            if partial.seen != len(partial.payloads):
                partial.seen = len(partial.payloads)
                partial.touched_at = now
            idle_s = now - partial.touched_at
            if partial.expires_at <= now:
                self.end(message_id)
            elif idle_s > RELIABLE_TIMEOUT_S:
                self.forget(message_id)
                self._remember(self.forgotten, message_id)
            elif (
                idle_s > BEST_EFFORT_TIMEOUT_S
                and partial.head is not None
                and not partial.head.flags & MessageFlag.RELIABLE
            ):
                self.end(message_id)

    def missing(self, message_id: int) -> list[tuple[int, int]] | None:
        """(first, count) of the positions not yet here; None where nothing is known of the message."""
        partial = self._partials.get(message_id)
        if partial is None or partial.head is None:
            return None
        gaps: list[tuple[int, int]] = []
        expected = 0
        for position in sorted(partial.payloads):
            if position > expected:
                gaps.append((expected, position - expected))
            expected = position + 1
        if expected < partial.head.fragments:
            gaps.append((expected, partial.head.fragments - expected))
        return gaps

    def _finish(self, message_id: int) -> None:
        self._remember(self.finished, message_id)

    def _remember(self, numbers: RangeSet, message_id: int) -> None:
        before = len(numbers)
        numbers.add(message_id)
        if len(numbers) > self._limits.finished_ranges_per_peer or self._account.too_many_ranges(len(numbers)):
            # The oldest gap is given up: what would still fill it is older than thousands of finished messages.
            numbers.fill_lowest_gap()
        if len(numbers) != before:
            self._account.count_ranges(len(numbers) - before)
