"""Which round trips say how long the path is: acknowledged packets -> the estimators of one peer.

1. `on_acknowledged` notes the end of an outage, from the time without acknowledgements before it.
2. `sample` adds the round trip of an acknowledged packet, and decides whether it counts for the congestion window.

Urgent packets overtake the others in a radio's queues, so theirs do not count while others are acknowledged. Those of
packets sent before the end of an outage show how long it was.
"""

from udp_mesh.core.congestion.rtt import RttEstimator
from udp_mesh.core.sender.sent_packets import SendSnapshot

NON_URGENT_RTT_VALID_S = 1.0
"""While a round trip sample of a packet that is not urgent is younger than this, urgent ones do not count."""

OUTAGE_S = 0.1
OUTAGE_ROUND_TRIPS = 3.0
"""No acknowledgement for longer than both is an outage: more than a radio's repetitions of a frame take, or a longer
route."""


class RoundTrips:
    """Times in seconds."""

    __slots__ = ("_non_urgent_sampled_at", "_outage_ended_at", "path", "urgent")

    def __init__(self) -> None:
        self.path = RttEstimator()
        self.urgent = RttEstimator()
        """Of urgent packets only: in a radio's queues they overtake others (Wi-Fi access categories)."""
        self._non_urgent_sampled_at = float("-inf")
        self._outage_ended_at: float | None = None
        """Until the round trip of a packet sent after the last outage is known."""

    def on_acknowledged(self, last_progress: float, now: float) -> None:
        """Record that packets are acknowledged; the last ones before were at `last_progress`."""
        smoothed_rtt = self.path.smoothed_rtt
        if smoothed_rtt is not None and now - last_progress > max(OUTAGE_S, OUTAGE_ROUND_TRIPS * smoothed_rtt):
            self._outage_ended_at = now

    def sample(self, snapshot: SendSnapshot, ack_delay_s: float, now: float) -> bool:
        """Add the round trip of a packet. True if it counts for the congestion window."""
        round_trip_s = max(1e-5, now - snapshot.sent_at - ack_delay_s)
        if snapshot.urgent:
            self.urgent.sample(round_trip_s, now)
            if now < self._non_urgent_sampled_at + NON_URGENT_RTT_VALID_S:
                return False
        else:
            self._non_urgent_sampled_at = now
        if self._outage_ended_at is not None and snapshot.sent_at >= self._outage_ended_at:
            self._outage_ended_at = None
            self.path.restart_smoothed()
        self.path.sample(round_trip_s, now)
        return self._outage_ended_at is None
