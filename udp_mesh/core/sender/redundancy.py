"""Redundant copies of small urgent fragments on a lossy path: sent -> copied soon, and again if the acknowledgment is
overdue.

1. `schedule` records when the copies of a fragment sent for the first time are due.
2. `pop_due` returns what is due; a fragment still unacknowledged then is scheduled again, a few times.

On a path with little loss nothing is copied. From `twice_loss` on, one copy is sent soon, and `EARLY_COPIES` adds more
as loss grows: 20 % loss takes all of three transmissions in one case of 125, all of four in one of 625.
"""

from heapq import heappop, heappush

from udp_mesh.core.sender.message import OutgoingMessage

OVERDUE_ROUND_TRIPS = 1.1
"""Round trips after which the acknowledgment of an urgent fragment, requested at once, is overdue."""

MAX_OVERDUE_COPIES = 6
"""Copies sent for overdue acknowledgments; after that the peer is nearly unresponsive and is probed instead."""

EARLY_COPIES = ((0.1, 3), (0.15, 6))
"""(loss, gaps): from this loss rate on, one more copy is sent so many gaps after the first. Losses come in bursts, so
the gaps grow."""

ANSWER_GAPS = 3
"""An early copy is left out if the answer is overdue at most so many gaps later: then comes one only if needed."""

_NEVER = float("inf")


class RedundantCopies:
    """The copies scheduled for one peer; `next_at` is when the next one is due (infinite: there is none)."""

    __slots__ = ("_heap", "_serial", "next_at")

    def __init__(self) -> None:
        self._heap: list[tuple[float, int, OutgoingMessage, int, int]] = []
        """(when, serial, message, position, how often it may be scheduled again)."""
        self._serial = 0
        self.next_at = _NEVER

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
        """Schedule copies of a fragment just sent for the first time."""
        if not twice:
            return
        self._push(now + gap_s, message, position, 0)
        for min_loss, gaps in EARLY_COPIES:
            is_awaited = message.reliable and urgent_timeout_s <= (gaps + ANSWER_GAPS) * gap_s
            if loss >= min_loss and not is_awaited:
                self._push(now + gaps * gap_s, message, position, 0)
        if message.reliable:
            self._push(now + urgent_timeout_s, message, position, MAX_OVERDUE_COPIES - 1)

    def pop_due(self, now: float, urgent_timeout_s: float) -> list[tuple[OutgoingMessage, int]]:
        """Fragments to copy now, unless acknowledged."""
        fragments = []
        while self._heap and self._heap[0][0] <= now:
            _, _, message, position, times = heappop(self._heap)
            # A best-effort message ends when sent; whether it arrived is unknown.
            if message.reliable and (message.ended or message.arrived[position]):
                continue
            fragments.append((message, position))
            if times:
                self._push(now + urgent_timeout_s, message, position, times - 1)
        self.next_at = self._heap[0][0] if self._heap else _NEVER
        return fragments

    def clear(self) -> None:
        self._heap.clear()
        self.next_at = _NEVER

    def _push(self, at: float, message: OutgoingMessage, position: int, times: int) -> None:
        self._serial += 1
        heappush(self._heap, (at, self._serial, message, position, times))
        self.next_at = self._heap[0][0]
