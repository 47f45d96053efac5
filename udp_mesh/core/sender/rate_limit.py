"""A topic's rate limit as a token bucket: while it is empty, the topic's messages are parked.

When there are tokens again, only what they suffice for returns to the level of each peer, so that a long queue costs no
more than a short one. The rest stays parked in order: a later message to the same peer does not overtake it. What waits
for a peer that is unresponsive returns at once, because its level knows what is sent first after an outage.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterator

from udp_mesh.core.sender.scheduler import Run
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender

BURST_S = 0.1
"""Capacity of the bucket: short enough to keep the limit over one second, long enough for a message."""
PAUSE_S, RETURN_AGAIN_S = 0.001, 0.1
"""Until more is returned after something of what was returned was sent, and although nothing was: the windows of its
peers are full, or it has ended."""


class _Parked:
    """What waits for one peer: single fragments to be retransmitted, and messages in the order accepted."""

    __slots__ = ("fresh", "retransmits")

    def __init__(self) -> None:
        self.retransmits: deque[Run] = deque()
        self.fresh: deque[Run] = deque()

    def add(self, run: Run) -> None:
        if run.retransmit:
            self.retransmits.append(run)
            return
        if not self.fresh or _number(run) >= _number(self.fresh[-1]):
            self.fresh.append(run)
        else:
            # It was returned before the tokens were used up.
            self.fresh.insert(bisect_right(self.fresh, _number(run), key=_number), run)

    def is_overtaken_by(self, run: Run) -> bool:
        while self.fresh and self.fresh[0].message.ended:
            self.fresh.popleft()
        if run.retransmit or not self.fresh:
            return False
        return _number(run) > _number(self.fresh[0])

    def take(self) -> Run | None:
        """The next run that has not ended."""
        for queue in (self.retransmits, self.fresh):
            while queue:
                run = queue.popleft()
                if not run.message.ended:
                    return run
        return None


def _number(run: Run) -> int:
    """Messages are numbered as they are accepted."""
    return run.message.accepted.message_id


class TokenBucket:
    """One topic's bucket, shared by all destinations. It may go into debt by one `consume`."""

    __slots__ = ("_again_at", "_at", "_burst_s", "_bytes", "_parked", "_returned_at", "bytes_per_s")

    def __init__(self, bytes_per_s: int, now: float, *, burst_s: float = BURST_S) -> None:
        self.bytes_per_s = bytes_per_s
        self._burst_s = burst_s
        self._bytes = bytes_per_s * burst_s
        self._at = now
        self._parked: dict[Sender, _Parked] = {}
        self._returned_at = float("-inf")
        self._again_at = float("-inf")
        """Not before then, more is returned."""

    @property
    def has_parked(self) -> bool:
        return bool(self._parked)

    def parked(self) -> Iterator[Run]:
        """What waits for tokens."""
        for waiting in self._parked.values():
            yield from waiting.retransmits
            yield from waiting.fresh

    def has_tokens(self, now: float) -> bool:
        """Whether a datagram may be sent now."""
        self._bytes = min(self.bytes_per_s * self._burst_s, self._bytes + (now - self._at) * self.bytes_per_s)
        self._at = now
        return self._bytes > 0

    def consume(self, count: int, sender: Sender | None = None) -> None:
        """Record that `count` bytes were sent, to a peer that is last in turn now."""
        self._bytes -= count
        self._again_at = self._returned_at + PAUSE_S
        if sender is not None and (waiting := self._parked.pop(sender, None)) is not None:
            self._parked[sender] = waiting

    def ready_at(self) -> float:
        """When something that is parked can return."""
        return max(self._at + max(0.0, 1.0 - self._bytes) / self.bytes_per_s, self._again_at)

    def must_wait(self, sender: Sender, run: Run, now: float) -> bool:
        """Whether a run is to be parked: there are no tokens, or earlier messages to this peer wait for them."""
        if not self.has_tokens(now):
            return True
        waiting = self._parked.get(sender)
        return waiting is not None and waiting.is_overtaken_by(run)

    def park(self, sender: Sender, run: Run) -> None:
        """Keep a run that was taken from its level."""
        waiting = self._parked.get(sender)
        if waiting is None:
            waiting = self._parked[sender] = _Parked()
        waiting.add(run)

    def unpark(self, now: float) -> list[Sender]:
        """Return to the front of their levels, in order, what the tokens suffice for, if it is time. Returns to whom:
        first the one whose turn it is."""
        if not self.has_tokens(now) or now < self._again_at:
            return []
        self._returned_at, self._again_at = now, now + RETURN_AGAIN_S
        senders = list(self._parked)
        for sender in senders:
            self._return(sender, float("inf") if sender.state is SendState.UNRESPONSIVE else self._bytes)
        return senders

    def unpark_all(self) -> None:
        for sender in list(self._parked):
            self._return(sender, float("inf"))

    def _return(self, sender: Sender, budget: float) -> None:
        waiting = self._parked[sender]
        taken: list[Run] = []
        while budget > 0:
            run = waiting.take()
            if run is None:
                del self._parked[sender]
                break
            taken.append(run)
            size = len(run.message.body)
            budget -= 1 + (min(size, run.message.fragment_bytes) if run.retransmit else size)
        for run in taken:
            if run.retransmit:
                sender.scheduler.push_retransmit(run.message, run.position)
        for run in reversed(taken):
            if not run.retransmit:
                sender.scheduler.push(run.message, first=True)
