"""Second copies of small urgent pieces: left over a lossy way -> again soon, and again when the answer is overdue.

1. `later` is told of each small urgent piece that left for the first time, and notes when its copies are due.
2. `due` hands out what is due; what is still unanswered by then is noted once more, a few times.

On a way that loses little nothing is copied; from `twice_loss` on one copy leaves soon, and `EARLY` adds to it as more
is lost: 20 % loss takes all of three sendings in one case of 125, all of four in one of 625.
"""

from heapq import heappop, heappush

from udp_mesh.core.sender.message import Outgoing

OVERDUE_ROUND_TRIPS = 1.1
"""Round trips after which the answer to an urgent piece, asked for at once, is overdue."""

OVERDUE_TIMES = 6
"""So often an overdue answer brings another copy; then the peer is nearly silent, and probes do."""

EARLY = ((0.1, 3), (0.15, 6))
"""From each loss on one more sending leaves, so many gaps after the first: what is lost is often lost together, so they
lie ever further apart."""


class Copies:
    """The copies noted for one peer."""

    __slots__ = ("_heap", "_serial")

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, Outgoing, int, int]] = []
        """(when, serial, message, position, how often it may be noted again)."""
        self._serial = 0

    def __bool__(self) -> bool:
        return bool(self._heap)

    def next_at(self) -> float:
        """When the next is due; only meaningful while there are any."""
        return self._heap[0][0]

    def later(
        self, message: Outgoing, position: int, now: float, *, gap_s: float, twice: bool, loss: float, overdue_s: float
    ) -> None:
        """The piece left just now for the first time."""
        if not twice:
            return
        self._note(now + gap_s, message, position, 0)
        for least_loss, gaps in EARLY:
            if loss >= least_loss:
                self._note(now + gaps * gap_s, message, position, 0)
        if message.reliable:
            self._note(now + overdue_s, message, position, OVERDUE_TIMES - 1)

    def due(self, now: float, overdue_s: float) -> list[tuple[Outgoing, int]]:
        """Pieces to be sent again now, unless they have arrived."""
        pieces = []
        while self._heap and self._heap[0][0] <= now:
            _, _, message, position, times = heappop(self._heap)
            # Best effort ends when it leaves, and nobody tells whether it arrived.
            if message.reliable and (message.ended or message.arrived[position]):
                continue
            pieces.append((message, position))
            if times:
                self._note(now + overdue_s, message, position, times - 1)
        return pieces

    def clear(self) -> None:
        self._heap.clear()

    def _note(self, at: float, message: Outgoing, position: int, times: int) -> None:
        self._serial += 1
        heappush(self._heap, (at, self._serial, message, position, times))
