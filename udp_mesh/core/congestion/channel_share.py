"""Our share of a channel on which several nodes send: reported send rates in -> fraction of the target queue out.

1. `on_send_rate` records what another node reports to send; nodes that send next to nothing are ignored.
2. `queue_share` estimates the number of senders as (sum of rates)^2 / sum of squares: four nodes that send alike count
   as 4, one with three that only acknowledge as little more than 1, and all nodes that hear each other get the same
   number.

The channel stays busy while any node has a frame to send, so each of n senders needs less queue than a single one, and
an urgent message waits behind less of its own robot's bulk. Dividing by the root of two for two senders, and by less
than the root of n for more of them, was measured to cost little throughput. Nodes that send less than others keep more
queue, and vice versa, which equalizes the shares.
"""

import math

MIN_BYTES_PER_S = 10_000.0
"""Slower nodes use hardly any of the slowest channel (1 Mbit/s). Also bounds what is stored in a large team."""

MIN_SENDERS = 1.5
"""Fewer are one sender and the nodes that acknowledge it."""

EXPONENT_OF_TWO, EXPONENT_OF_MORE = 0.5, 0.4
"""A sender's queue is divided by the number of senders to this power, up to two of them and from there on. With the
root of n for any n, four senders left a bottleneck idle now and then."""

MAX_CORRECTION = 2.0
"""Bounds the correction of unequal shares: rates of the last second are noisy."""

MAX_SHARE = 0.9
"""With other senders, whatever the correction."""

RATE_VALID_S = 10.5
"""A reported rate is valid for at least this long, until several of the sparsest heartbeats of a small team were
missed."""


class ChannelShare:
    """The nodes known to send much, by boot id."""

    __slots__ = ("_others",)

    def __init__(self) -> None:
        self._others: dict[bytes, tuple[float, float]] = {}
        """Bytes per second, and until when that is valid."""

    def on_send_rate(self, boot_id: bytes, bytes_per_s: float, now: float, *, valid_s: float = RATE_VALID_S) -> None:
        """Record the total send rate reported in a heartbeat; the next heartbeat is overdue after `valid_s`."""
        if bytes_per_s >= MIN_BYTES_PER_S:
            self._others[boot_id] = (bytes_per_s, now + max(RATE_VALID_S, valid_s))
        elif self._others:
            self._others.pop(boot_id, None)

    def queue_share(self, own_bytes_per_s: float, now: float) -> float:
        """Our fraction of a single sender's queue: 1 if no other node sends, otherwise less."""
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
        queues = math.pow(min(senders, 2.0), EXPONENT_OF_TWO) * math.pow(max(senders / 2.0, 1.0), EXPONENT_OF_MORE)
        return min(MAX_SHARE, min(MAX_CORRECTION, max(1 / MAX_CORRECTION, correction)) / queues)
