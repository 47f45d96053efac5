"""Acknowledgments that keep a legacy sender going, which never retransmits and keeps three fragments in flight.

A lost fragment or acknowledgment occupies one of its three slots for 10 s; then it drops its whole queue. It ignores
acknowledgments of fragments that are not in flight. So, in addition to the acknowledgment of each fragment:

1. Each is repeated once after a short time, and once more if there was recent loss.
2. Fragments that must have been sent before one that arrived, and are missing, are acknowledged too: they will not be
   sent again. Fragments of a message come in order; messages in the order of their priorities, which are not on the
   wire.
3. While fragments arrive, and with each heartbeat of the peer, the fragments expected next are acknowledged too: they
   may have been lost in flight.

4. A run of ours that replaces another one knows what that one had received (`ReceivePosition`), and acknowledges the
   fragments that may have been sent since: with all three slots taken, nothing else would arrive for 10 s.

A message of which nothing has arrived for `STALE_S` is not acknowledged any more, since its sender has dropped it.
Fragments acknowledged this way stay lost, but nothing behind them is.
"""

from collections import OrderedDict, deque
from typing import NamedTuple

from udp_mesh.wire.legacy import LAST_SEQUENCE, LegacyAck, LegacyPayload

REPEAT_S = 0.04
"""Delay of the first repetition: longer than a burst of losses."""

REPEAT_LOSSY_S = 0.4
"""Delay of the second repetition, sent if losses were seen within `LOSSY_FOR_S`."""

LOSSY_FOR_S = 10.0

PREDICT_INTERVAL_S = 0.05
"""Interval of predicted acknowledgments while fragments arrive, and for `PREDICT_FOR_S` after the last one."""

PREDICT_FOR_S = 1.0

WINDOW = 3
"""Fragments in flight: the default of the legacy sender."""

MAX_GAP = 16
"""Missing fragments of one message acknowledged when a later one arrives: more than any configured window."""

MAX_BEHIND = 8
"""Messages before the latest that may still have fragments in flight."""

STALE_S = 30.0
"""Three times as long as the legacy sender waits for an acknowledgment before it drops its queue."""

MAX_REPEATS = 4096
"""Scheduled repetitions: those of one second at 40 Mbit/s."""


RESTORED_STEP, RESTORED_STEPS = 40, 16
"""Messages, and fragments of each incomplete one, that may have been sent after the position was saved: acknowledged
step by step, so that a default receive buffer holds the acknowledgments of a step. All steps reach as far as a sender
of 600 messages a second comes in one second."""


class ReceivePosition(NamedTuple):
    """The newest messages received from a legacy peer, with which the next run of this node can free its slots."""

    latest: int
    """The latest message number."""
    recent: tuple[tuple[int, int, int], ...]
    """(message number, next expected position, number of fragments) of the latest messages."""


class _Progress(NamedTuple):
    expected: int
    """The next position."""
    total: int
    arrived_at: float
    """When the last fragment did; infinite if it did in an earlier run."""


class LegacyAcks:
    """`on_fragment` returns what to acknowledge in addition to the fragment; `next_at` is when `due` returns more."""

    __slots__ = (
        "_latest",
        "_lossy_until",
        "_payload_at",
        "_predicted_at",
        "_recent",
        "_repeats",
        "_restored",
        "_restored_step",
    )

    def __init__(self, position: ReceivePosition | None = None) -> None:
        """`position` is that of the previous run, if it is known."""
        self._latest: int | None = None if position is None else position.latest
        """The latest message number."""
        self._recent: OrderedDict[int, _Progress] = OrderedDict()
        """Message number -> what has arrived of the latest messages."""
        for sequence, expected, total in () if position is None else position.recent:
            self._recent[sequence] = _Progress(expected, total, float("inf"))
        self._restored = position is not None
        """Nothing has arrived in this run yet."""
        self._restored_step = RESTORED_STEPS
        self._repeats: deque[tuple[float, LegacyAck, bool]] = deque()
        self._payload_at = float("-inf")
        self._predicted_at = float("-inf")
        self._lossy_until = float("-inf")

    def on_fragment(self, fragment: LegacyPayload, now: float) -> list[LegacyAck]:
        """Process an acknowledged fragment; returns what else to acknowledge."""
        self._restored = False
        if now >= self._payload_at + PREDICT_FOR_S:
            self._predicted_at = now
        self._payload_at = now
        self._repeat(LegacyAck(fragment.sequence, fragment.position), now)
        more: list[LegacyAck] = []
        expected, total, _ = self._recent.get(fragment.sequence, (0, fragment.total, now))
        if total != fragment.total:
            # Its numbers have restarted.
            expected = 0
        if fragment.position > expected:
            self._lossy_until = now + LOSSY_FOR_S
            first = max(expected, fragment.position - MAX_GAP)
            more += [LegacyAck(fragment.sequence, position) for position in range(first, fragment.position)]
        self._recent[fragment.sequence] = _Progress(max(expected, fragment.position + 1), fragment.total, now)
        self._recent.move_to_end(fragment.sequence)
        while len(self._recent) > MAX_BEHIND:
            self._recent.popitem(last=False)
        for ack in more:
            self._repeat(ack, now)
        for sequence in self._skipped(fragment.sequence):
            # They may only have been overtaken: their own acknowledgments go first.
            for ack in _first(sequence):
                self._repeat(ack, now)
        return more

    def heartbeat(self, now: float) -> list[LegacyAck]:
        """The peer sent a heartbeat: release what may be stuck."""
        if not self._restored:
            return self._predicted(now)
        self._restored_step = 0
        self._predicted_at = float("-inf")
        # Less urgent messages have lower numbers than the latest one: look behind each that was seen.
        following = {_sequence_behind(sequence, -ahead) for sequence in self._recent for ahead in range(1, WINDOW + 1)}
        return [ack for sequence in following - self._recent.keys() for ack in _first(sequence)]

    def position(self) -> ReceivePosition | None:
        """The position for the next run of this node (None: nothing was received)."""
        if self._latest is None:
            return None
        return ReceivePosition(
            self._latest, tuple([(sequence, seen.expected, seen.total) for sequence, seen in self._recent.items()])
        )

    def _skipped(self, sequence: int) -> list[int]:
        """Messages before this one of which nothing arrived. Updates `_latest`."""
        latest = self._latest
        ahead = MAX_BEHIND + 1 if latest is None else (sequence - latest) % LAST_SEQUENCE
        if ahead == 0 or ahead > LAST_SEQUENCE - 64:
            # A fragment of the latest message, or of a less urgent one that waited.
            return []
        self._latest = sequence
        # If either side has just started, anything before may be in flight.
        numbers = [_sequence_behind(sequence, behind) for behind in range(1, min(ahead - 1, MAX_BEHIND) + 1)]
        return [number for number in numbers if number not in self._recent]

    def due(self, now: float) -> list[LegacyAck]:
        """Repeated and predicted acknowledgments due now."""
        acks: list[LegacyAck] = []
        while self._repeats and self._repeats[0][0] <= now:
            at, ack, again = self._repeats.popleft()
            acks.append(ack)
            if again and now < self._lossy_until:
                self._schedule(at + REPEAT_LOSSY_S, ack, again=False)
        # Judged by the time they were due, as in `next_at`: a late call must not leave that timer in the past.
        predict_at = self._predicted_at + PREDICT_INTERVAL_S
        if now >= predict_at and self._predicts(predict_at):
            self._predicted_at = now
            if self._restored:
                acks += self._predicted(now, self._restored_step * RESTORED_STEP, RESTORED_STEP)
                self._restored_step += 1
            else:
                acks += self._predicted(now)
        return acks

    def _predicts(self, at: float) -> bool:
        """Whether predicted acknowledgments are sent at this time without a heartbeat."""
        return self._restored_step < RESTORED_STEPS if self._restored else at < self._payload_at + PREDICT_FOR_S

    def next_at(self) -> float:
        at = self._repeats[0][0] if self._repeats else float("inf")
        predict_at = self._predicted_at + PREDICT_INTERVAL_S
        return min(at, predict_at) if self._predicts(predict_at) else at

    def _predicted(self, now: float, skip: int = 0, reach: int = WINDOW) -> list[LegacyAck]:
        """The fragments expected next, of each incomplete message and of those after the latest: `reach` of each, after
        the first `skip`."""
        if self._latest is None:
            return []
        acks: list[LegacyAck] = []
        for sequence, (expected, total, arrived_at) in self._recent.items():
            if now - arrived_at > STALE_S:
                continue
            first = expected + skip
            acks += [LegacyAck(sequence, position) for position in range(first, min(total, first + reach))]
        for ahead in range(1, reach + 1):
            acks += _first(_sequence_behind(self._latest, -skip - ahead))[: reach + 1 - ahead]
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


def _sequence_behind(sequence: int, behind: int) -> int:
    """The message number `behind` places before this one; they run from 1 to `LAST_SEQUENCE`."""
    return (sequence - 1 - behind) % LAST_SEQUENCE + 1


def _first(sequence: int) -> list[LegacyAck]:
    return [LegacyAck(sequence, position) for position in range(WINDOW)]
