"""Several nodes send on one channel: what each says in heartbeats that it sends -> how much queue is ours to keep.

1. `on_send_rate` takes in what another node says it sends; those that send next to nothing are left out.
2. `queue_share` counts the senders, each by its share: (sum of rates)^2 / sum of squares. Four nodes that send alike
   are 4, one with three that only acknowledge is little more than 1, and all who hear each other come to one number.

The channel stays busy while anyone has a frame to send, so each of n senders need keep less queue than a single one
would, and an urgent message stands behind less of its own robot's bulk; the root of n was found to cost little
throughput. Who sends less than the others keeps more, who sends more keeps less: that draws the shares together.
"""

import math

MIN_BYTES_PER_S = 10_000.0
"""Who sends less takes hardly any of the slowest channel (1 Mbit/s); and bounds what is remembered in a large team."""

MIN_SENDERS = 1.5
"""Fewer are one sender and those who answer it."""

MAX_CORRECTION = 2.0
"""By so much at most unequal shares are corrected: rates of the last second scatter."""

MAX_SHARE = 0.9
"""Among others, whatever the correction."""

RATE_VALID_S = 10.5
"""What a heartbeat says holds at least so long: until some of the most sparse ones of a small team have been missed."""


class ChannelShare:
    """The nodes heard to send much, by boot id."""

    __slots__ = ("_others",)

    def __init__(self) -> None:
        self._others: dict[bytes, tuple[float, float]] = {}
        """Bytes per second, and until when that holds."""

    def on_send_rate(self, boot_id: bytes, bytes_per_s: float, now: float, *, valid_s: float = RATE_VALID_S) -> None:
        """A heartbeat says how much its sender sends to everybody; the next one is missed after `valid_s`."""
        if bytes_per_s >= MIN_BYTES_PER_S:
            self._others[boot_id] = (bytes_per_s, now + max(RATE_VALID_S, valid_s))
        elif self._others:
            self._others.pop(boot_id, None)

    def queue_share(self, own_bytes_per_s: float, now: float) -> float:
        """The part of a single sender's queue that is ours to keep: 1 alone, below 1 among others."""
        others = self._others
        if not others:
            return 1.0
        for boot_id in [boot_id for boot_id, (_, until) in others.items() if now > until]:
            del others[boot_id]
        rates = [max(own_bytes_per_s, MIN_BYTES_PER_S), *(rate for rate, _ in others.values())]
        total = sum(rates)
        senders = total * total / sum(rate * rate for rate in rates)
        if senders < MIN_SENDERS:
            return 1.0
        correction = total / senders / rates[0]
        return min(MAX_SHARE, min(MAX_CORRECTION, max(1 / MAX_CORRECTION, correction)) / math.sqrt(senders))
