"""How many packets may leave for one peer now, and when to look again.

1. `cwnd_room`: what the window leaves room for, plus what the link should have delivered while acknowledgements are
   late.
2. `send_quota`: that, plus the excess of urgent pieces; for the rest no more than the pacing allows. A silent peer gets
   probes alone.
3. `next_send_at`: when nothing may be sent, the time at which pacing, or a late acknowledgement, changes that.
4. `ack_spacing`: how often packets ask for an acknowledgement, which is what makes one late.

Acknowledgements go missing in bursts and come late from a process that was not scheduled; a window that waits for them
leaves the link idle. For some tens of milliseconds the link is presumed to go on as it did.
"""

from udp_mesh.core.sender.sender import Sender

MAX_ACK_SPACING = 10
"""Packets between two that ask for an acknowledgement at once."""

ACK_SPACING_FRACTION = 0.2
"""Part of the window between two packets that ask for an acknowledgement at once."""

MIN_LOSS_FACTOR = 0.5
LOSS_WEIGHT = 5.0
"""Acknowledgements are lost too: with each percent of loss they are asked for 5 % more often, up to twice as often."""

LATE_AFTER_S = 0.006
"""Acknowledgements are late when they stay away for longer than their spacing takes, and at least this long."""

MAX_URGENT_WAIT_S = 0.1
"""Longest an urgent piece waits for what is on its way: that may stand in a queue of seconds, or be lost unnoticed. One
datagram, with all that is small and waits, delays bulk by a hundredth."""

ASSUMED_DELIVERY_S = 0.03
"""So long the link is presumed to go on delivering; what its packets then wait is bounded by it."""


def cwnd_room(sender: Sender, now: float) -> int:
    """Packets for which the window has room; below 0 where more are on their way."""
    congestion = sender.congestion
    packets = congestion.cwnd
    if sender.timing_out:
        # Packets leave the window by their age only: more of them are young enough than within a round trip.
        smoothed_rtt = sender.rtt.smoothed_rtt
        if smoothed_rtt is not None and congestion.assume_delivery():
            packets *= max(1.0, sender.pto_s() / smoothed_rtt)
    else:
        late_s = now - _late_at(sender)
        if late_s > 0 and congestion.assume_delivery():
            packets += (congestion.capacity_packets_per_s() or 0.0) * min(late_s, ASSUMED_DELIVERY_S)
    room = int(packets) - sender.in_flight.outstanding
    if room <= 0 and congestion.drain_overdue(now):
        # A drain ends with the round trip of a piece that is not urgent: one may leave whatever else is on its way.
        room = max(room, 1 - sender.in_flight.non_urgent_outstanding())
    return room


def send_quota(sender: Sender, room: int, now: float, packets_per_s: float | None, *, urgent: bool) -> int:
    """Packets that may leave now; `packets_per_s` is the pacing, which urgent pieces do not wait for."""
    if sender.unresponsive_since is not None:
        return sender.probe_credit
    packets = room
    if urgent:
        packets += sender.rates.urgent_excess_packets
        if packets <= 0 and now >= urgent_wait_until(sender):
            packets = 1
    else:
        packets = min(packets, sender.pacer.packets_allowed(now, packets_per_s))
    return max(packets, sender.probe_credit)


def urgent_wait_until(sender: Sender) -> float:
    """When an urgent piece leaves whatever is on its way (to a silent peer it is a probe)."""
    return sender.urgent_sent_at + MAX_URGENT_WAIT_S


def next_send_at(sender: Sender, room: int, now: float, packets_per_s: float | None) -> float | None:
    """When more may leave although nothing arrives until then; None: only an acknowledgement changes anything."""
    if sender.unresponsive_since is not None:
        return None
    if room > 0:
        return sender.pacer.wake_at(packets_per_s)
    late_at = _late_at(sender)
    if sender.timing_out or now >= late_at + ASSUMED_DELIVERY_S or not sender.congestion.assume_delivery():
        return None
    return max(now, late_at) + sender.rates.pace_quantum_s


def ack_spacing(sender: Sender) -> int:
    """Packets between two that ask for an acknowledgement at once."""
    loss_factor = max(MIN_LOSS_FACTOR, 1.0 - LOSS_WEIGHT * sender.loss)
    return max(2, min(MAX_ACK_SPACING, int(sender.congestion.cwnd * ACK_SPACING_FRACTION * loss_factor)))


def _late_at(sender: Sender) -> float:
    """When the next acknowledgement should have come."""
    capacity = sender.congestion.capacity_packets_per_s()
    spacing_s = ack_spacing(sender) / capacity if capacity else 0.0
    return sender.last_progress + max(LATE_AFTER_S, spacing_s)
