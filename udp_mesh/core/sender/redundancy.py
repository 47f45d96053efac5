"""Second copies of small urgent pieces: left over a lossy way -> again soon, and again when the answer is overdue.

1. `schedule` is told of each small urgent piece that left for the first time, and notes when its copies are due.
2. `pop_due` hands out what is due; what is still unanswered by then is noted once more, a few times.

On a path that loses little nothing is copied; from `twice_loss` on one copy is sent soon, and `EARLY_COPIES` adds to it
as more is lost: 20 % loss takes all of three sendings in one case of 125, all of four in one of 625.
"""

from heapq import heappop, heappush

from udp_mesh.core.sender.message import OutgoingMessage

OVERDUE_ROUND_TRIPS = 1.1
"""Round trips after which the answer to an urgent piece, asked for at once, is overdue."""

MAX_OVERDUE_COPIES = 6
"""So often an overdue answer brings another copy; then the peer is nearly silent, and probes do."""

EARLY_COPIES = ((0.1, 3), (0.15, 6))
"""From each loss on one more sending leaves, so many gaps after the first: what is lost is often lost together, so they
lie ever further apart."""


class RedundantCopies:
    """The copies noted for one peer."""

    __slots__ = ("_heap", "_serial")

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, OutgoingMessage, int, int]] = []
        """(when, serial, message, position, how often it may be noted again)."""
        self._serial = 0

    def __bool__(self) -> bool:
        return bool(self._heap)

    def next_at(self) -> float:
        """When the next is due; only meaningful while there are any."""
        return self._heap[0][0]

    def schedule(
        self,
        message: OutgoingMessage,
        position: int,
        now: float,
        *,
        gap_s: float,
        twice: bool,
        loss: float,
        urgent_timeout_s: float,
    ) -> None:
        """The piece left just now for the first time."""
        if not twice:
            return
        self._push(now + gap_s, message, position, 0)
        for min_loss, gaps in EARLY_COPIES:
            if loss >= min_loss:
                self._push(now + gaps * gap_s, message, position, 0)
        if message.reliable:
            self._push(now + urgent_timeout_s, message, position, MAX_OVERDUE_COPIES - 1)

    def pop_due(self, now: float, urgent_timeout_s: float) -> list[tuple[OutgoingMessage, int]]:
        """Pieces to be sent again now, unless they have arrived."""
        fragments = []
        while self._heap and self._heap[0][0] <= now:
            _, _, message, position, times = heappop(self._heap)
            # Best effort ends when it leaves, and nobody tells whether it arrived.
            if message.reliable and (message.ended or message.arrived[position]):
                continue
            fragments.append((message, position))
            if times:
                self._push(now + urgent_timeout_s, message, position, times - 1)
        return fragments

    def clear(self) -> None:
        self._heap.clear()

    def _push(self, at: float, message: OutgoingMessage, position: int, times: int) -> None:
        self._serial += 1
        heappush(self._heap, (at, self._serial, message, position, times))
