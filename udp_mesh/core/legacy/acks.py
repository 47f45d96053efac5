"""Acknowledgements that keep a fielded sender going, which resends nothing and lets three fragments be on their way.

A fragment or an acknowledgement that is lost takes one of its three places for 10 s; then it drops everything it has
queued. It ignores an acknowledgement of what is not on its way. So, besides the one for each fragment:

1. Each is repeated once a little later, and once more where losses were seen lately.
2. What must have been sent before a fragment that came, and is not here, is acknowledged too: it will not come again.
   Fragments of a message come in order; messages in the order of their priorities, which are not on the wire.
3. While fragments come, and with each of its heartbeats, so is what would come next: it may be on its way no more.

What is acknowledged in this way is lost, as it was when it was lost; nothing behind it is.
"""

from collections import OrderedDict, deque

from udp_mesh.wire.legacy import LAST_SEQUENCE, LegacyAck, LegacyPayload

REPEAT_S = 0.04
"""Until an acknowledgement is repeated: longer than a burst of losses."""

REPEAT_LOSSY_S = 0.4
"""Until it is repeated again, where losses were seen within `LOSSY_FOR_S`."""

LOSSY_FOR_S = 10.0

PREDICT_INTERVAL_S = 0.05
"""Between two looks at what would come next, while fragments come and for `PREDICT_FOR_S` after the last."""

PREDICT_FOR_S = 1.0

WINDOW = 3
"""Fragments that may be on their way: the fielded default."""

MAX_GAP = 16
"""Fragments of one message acknowledged at once because a later one came: more than a window that was ever set."""

MAX_BEHIND = 8
"""Messages before the latest that may still have fragments on their way."""

MAX_REPEATS = 4096
"""Repeats that wait: those of a second at 40 Mbit/s."""


class LegacyAcks:
    """`wanted` returns what to acknowledge besides what just came; `next_at` is when `due` has more."""

    __slots__ = ("_incomplete", "_latest", "_lossy_until", "_payload_at", "_predicted_at", "_repeats")

    def __init__(self) -> None:
        self._latest: int | None = None
        """The latest message number."""
        self._incomplete: OrderedDict[int, tuple[int, int]] = OrderedDict()
        """Message number -> the position expected next, and how many there are: the latest messages."""
        self._repeats: deque[tuple[float, LegacyAck, bool]] = deque()
        self._payload_at = float("-inf")
        self._predicted_at = float("-inf")
        self._lossy_until = float("-inf")

    def on_fragment(self, fragment: LegacyPayload, now: float) -> list[LegacyAck]:
        """A fragment was acknowledged: what else shall be."""
        if now >= self._payload_at + PREDICT_FOR_S:
            self._predicted_at = now
        self._payload_at = now
        self._repeat(LegacyAck(fragment.sequence, fragment.position), now)
        more: list[LegacyAck] = []
        expected, total = self._incomplete.get(fragment.sequence, (0, fragment.total))
        if total != fragment.total:
            # Its numbers have restarted.
            expected = 0
        if fragment.position > expected:
            self._lossy_until = now + LOSSY_FOR_S
            first = max(expected, fragment.position - MAX_GAP)
            more += [LegacyAck(fragment.sequence, position) for position in range(first, fragment.position)]
        self._incomplete[fragment.sequence] = (max(expected, fragment.position + 1), fragment.total)
        self._incomplete.move_to_end(fragment.sequence)
        while len(self._incomplete) > MAX_BEHIND:
            self._incomplete.popitem(last=False)
        for ack in more:
            self._repeat(ack, now)
        for sequence in self._skipped(fragment.sequence):
            # Perhaps they were only overtaken: their own answers leave first.
            for ack in _first(sequence):
                self._repeat(ack, now)
        return more

    def heartbeat(self) -> list[LegacyAck]:
        """The peer says that it is there: what may be stuck is let go."""
        return self._predicted()

    def _skipped(self, sequence: int) -> list[int]:
        """Messages before this one of which nothing came; `_latest` is brought up to date."""
        latest = self._latest
        ahead = MAX_BEHIND + 1 if latest is None else (sequence - latest) % LAST_SEQUENCE
        if ahead == 0 or ahead > LAST_SEQUENCE - 64:
            # Of the latest, or of a less urgent one that waited.
            return []
        self._latest = sequence
        # Where one of the two has just started, whatever came before may be on its way.
        numbers = [_before(sequence, behind) for behind in range(1, min(ahead - 1, MAX_BEHIND) + 1)]
        return [number for number in numbers if number not in self._incomplete]

    def due(self, now: float) -> list[LegacyAck]:
        """What is to be acknowledged, again or at a guess, at this time."""
        acks: list[LegacyAck] = []
        while self._repeats and self._repeats[0][0] <= now:
            at, ack, again = self._repeats.popleft()
            acks.append(ack)
            if again and now < self._lossy_until:
                self._schedule(at + REPEAT_LOSSY_S, ack, again=False)
        if now < self._payload_at + PREDICT_FOR_S and now >= self._predicted_at + PREDICT_INTERVAL_S:
            self._predicted_at = now
            acks += self._predicted()
        return acks

    def next_at(self) -> float:
        at = self._repeats[0][0] if self._repeats else float("inf")
        predict_at = self._predicted_at + PREDICT_INTERVAL_S
        return min(at, predict_at) if predict_at < self._payload_at + PREDICT_FOR_S else at

    def _predicted(self) -> list[LegacyAck]:
        """What would come next of each message under way, and of those after the latest."""
        if self._latest is None:
            return []
        acks: list[LegacyAck] = []
        for sequence, (expected, total) in self._incomplete.items():
            acks += [LegacyAck(sequence, position) for position in range(expected, min(total, expected + WINDOW))]
        for ahead in range(1, WINDOW + 1):
            acks += _first(_before(self._latest, -ahead))[: WINDOW + 1 - ahead]
        return acks

    def _repeat(self, ack: LegacyAck, now: float) -> None:
        self._schedule(now + REPEAT_S, ack, again=True)

    def _schedule(self, at: float, ack: LegacyAck, *, again: bool) -> None:
        if len(self._repeats) >= MAX_REPEATS:
            self._repeats.popleft()
        place = len(self._repeats)
        while place and self._repeats[place - 1][0] > at:
            place -= 1
        self._repeats.insert(place, (at, ack, again))


def _before(sequence: int, behind: int) -> int:
    """The message number so many before this one; they run from 1 to `LAST_SEQUENCE`."""
    return (sequence - 1 - behind) % LAST_SEQUENCE + 1


def _first(sequence: int) -> list[LegacyAck]:
    return [LegacyAck(sequence, position) for position in range(WINDOW)]
