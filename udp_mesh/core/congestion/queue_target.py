"""How much queue a sender keeps at the bottleneck, in packets.

It covers batched acknowledgments and pacing, and delays urgent messages by as much. A short path needs less, a lossy
one more; nodes that share a channel keep less each (see `channel_share`).
"""

QUEUE_S = 0.003
"""Target queue at the bottleneck: covers batched acknowledgments and pacing, and adds this much to urgent latency."""

MIN_QUEUE_S = 0.002
QUEUE_PER_ROUND_TRIP = 0.3
"""On a short path the window is small and acknowledged every few packets, so less queue suffices."""

LOSS_QUEUE_S = 0.002
FULL_LOSS_QUEUE_AT = 0.05
"""Losses leave holes in the queue: this much more keeps the link busy, limited by what urgent messages tolerate."""

MIN_QUEUE_PACKETS = 2.0
"""The same at low rates: fewer packets leave the link idle between acknowledgments."""

MIN_SHARED_QUEUE_PACKETS = 1.0
"""The same if other nodes send on the channel too and keep it busy."""

UNSHARED_FROM_LOSS = 0.2
"""With more loss all nodes wait at once more often, and urgent messages may take longer: from this loss rate on, the
queue is that of a single sender."""


def target_queue_s(min_rtt: float) -> float:
    """The target of a single sender on a path without loss."""
    return min(QUEUE_S, max(MIN_QUEUE_S, QUEUE_PER_ROUND_TRIP * min_rtt))


def loss_queue_s(loss: float) -> float:
    """The additional queue for losses."""
    return LOSS_QUEUE_S * min(1.0, loss / FULL_LOSS_QUEUE_AT)


def queue_packets(queue_s: float, packets_per_s: float, *, queue_share: float, loss: float) -> float:
    """`queue_s` at this rate, with a minimum; less of both if other nodes send too."""
    if queue_share == 1.0:
        return max(MIN_QUEUE_PACKETS, queue_s * packets_per_s)
    relief = min(1.0, loss / UNSHARED_FROM_LOSS)
    share = queue_share + (1.0 - queue_share) * relief
    min_packets = MIN_SHARED_QUEUE_PACKETS * queue_share
    min_packets += (MIN_QUEUE_PACKETS - min_packets) * relief
    return max(min_packets, queue_s * share * packets_per_s)
