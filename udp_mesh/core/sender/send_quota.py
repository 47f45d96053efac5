"""How many packets may be sent to one peer now, and when to try again.

1. `cwnd_room`: the room in the congestion window, plus what the link should have delivered while acknowledgments are
   late.
2. `send_quota`: that plus the excess for urgent fragments, which no drain holds back; for others at most what pacing
   allows. An unresponsive peer gets only probes.
3. `next_send_at`: when nothing may be sent, the time at which pacing or a late acknowledgment changes that.
4. `ack_spacing`: how often packets request an acknowledgment, which determines when one is late.
5. `pack_until`: how long small messages wait to share a datagram.

Acknowledgments are lost in bursts or delayed by a process that was not scheduled. A window that waits for them leaves
the link idle, so the link is assumed to keep delivering for some tens of milliseconds.
"""

from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.sender.sender import Sender

MAX_ACK_SPACING = 10
"""Maximum packets between two requests for an immediate acknowledgment."""

ACK_SPACING_FRACTION = 0.2
"""Fraction of the window between two requests for an immediate acknowledgment."""

MIN_LOSS_FACTOR = 0.5
LOSS_WEIGHT = 5.0
"""Acknowledgments are lost too: each percent of loss requests them 5 % more often, up to twice as often."""

LATE_AFTER_S = 0.004
"""Acknowledgments are late when overdue by more than their spacing, and by at least this long: little more than the
queue at the bottleneck lasts."""

MAX_URGENT_WAIT_S = 0.1
"""Maximum wait of an urgent fragment for packets in flight, which may be in a queue of seconds or lost unnoticed. One
datagram with all small waiting fragments delays bulk by a hundredth."""

ASSUMED_DELIVERY_S = 0.03
"""How long delivery is assumed to continue; bounds the queue this may build, that of the window itself included."""


def cwnd_room(sender: Sender, now: float) -> int:
    """Packets that the window has room for; negative if more are in flight."""
    congestion = sender.congestion
    packets = congestion.cwnd
    if congestion.is_queue_explained():
        # before that no acknowledgment is late
        is_late = sender.state is SendState.TIMING_OUT or now - sender.last_progress > LATE_AFTER_S
        if is_late and congestion.assume_delivery():
            packets = _with_assumed_delivery(sender, packets, now)
        # Copies are few and small. While the queue is longer than we know why, they take the place of bulk.
        packets += sender.in_flight.copies
    room = int(packets) - sender.in_flight.outstanding
    if room <= 0 and congestion.drain_overdue(now):
        # A drain ends with the round trip of a packet that is not urgent: one may be sent whatever else is in flight.
        room = max(room, 1 - sender.in_flight.non_urgent_outstanding())
    return room


def _with_assumed_delivery(sender: Sender, cwnd: float, now: float) -> float:
    """The window, and what the link should have delivered meanwhile, unless the window is such a queue by itself."""
    smoothed_rtt, min_rtt = sender.rtt.smoothed_rtt, sender.rtt.min_rtt
    capacity = sender.congestion.capacity_packets_per_s()
    if smoothed_rtt is None or min_rtt is None or capacity is None:
        return cwnd
    packets = cwnd
    if sender.state is SendState.TIMING_OUT:
        # Packets now leave the window by their age only, so more of them are in flight than within one round trip.
        packets *= sender.pto_s() / smoothed_rtt
    else:
        packets += capacity * min(now - _late_at(sender), ASSUMED_DELIVERY_S)
    return max(cwnd, min(packets, capacity * (min_rtt + ASSUMED_DELIVERY_S)))


def send_quota(sender: Sender, room: int, now: float, packets_per_s: float | None, *, urgent: bool) -> int:
    """Packets that may be sent now. `packets_per_s` is the pacing rate, which urgent fragments ignore."""
    if sender.state is SendState.UNRESPONSIVE:
        return sender.probing.credit
    packets = room
    if urgent:
        packets += sender.rates.urgent_excess_packets
        packets += int(sender.congestion.undrained_cwnd) - int(sender.congestion.cwnd)
        if packets <= 0 and now >= urgent_wait_until(sender):
            packets = 1
    else:
        packets = min(packets, sender.pacer.packets_allowed(now, packets_per_s))
    return max(packets, sender.probing.credit)


def urgent_wait_until(sender: Sender) -> float:
    """When an urgent fragment is sent whatever is in flight (to an unresponsive peer it is a probe)."""
    return sender.urgent_sent_at + MAX_URGENT_WAIT_S


def next_send_at(sender: Sender, room: int, now: float, packets_per_s: float | None) -> float | None:
    """When more may be sent even if nothing arrives. None: only an acknowledgment changes anything."""
    if sender.state is SendState.UNRESPONSIVE:
        return None
    if room > 0:
        return sender.pacer.wake_at(packets_per_s)
    late_at = _late_at(sender)
    if (
        sender.state is SendState.TIMING_OUT
        or now >= late_at + ASSUMED_DELIVERY_S
        or not sender.congestion.assume_delivery()
        or not sender.congestion.is_queue_explained()
    ):
        return None
    return max(now, late_at) + sender.rates.pace_quantum_s


def ack_spacing(sender: Sender) -> int:
    """Packets between two requests for an immediate acknowledgment."""
    loss_factor = max(MIN_LOSS_FACTOR, 1.0 - LOSS_WEIGHT * sender.loss.rate)
    return max(2, min(MAX_ACK_SPACING, int(sender.congestion.cwnd * ACK_SPACING_FRACTION * loss_factor)))


def _late_at(sender: Sender) -> float:
    """When the next acknowledgment was due."""
    capacity = sender.congestion.capacity_packets_per_s()
    spacing_s = ack_spacing(sender) / capacity if capacity else 0.0
    return sender.last_progress + max(LATE_AFTER_S, spacing_s)


def pack_until(sender: Sender, priority: int, room_bytes: int, now: float) -> float:
    """Until when the small messages of this level wait for others to share their datagram, which holds `room_bytes` of
    frames; `now`: they do not.

    As with Nagle's algorithm (RFC 896), a message is sent at once while none before it is in flight, so a lone one, and
    one that follows the acknowledgment of the last, never wait. In a stream, each datagram is followed by `pack_s`
    without another, unless one is full.
    """
    packing = sender.packing
    until = packing.sent_at + sender.rates.pack_s
    if (
        until <= now
        or priority <= sender.rates.urgent_priority
        or not (packing.is_stream or sender.in_flight.outstanding)
        or sender.state is not SendState.ACTIVE
        or sender.scheduler.fills(priority, room_bytes)
    ):
        return now
    return until
