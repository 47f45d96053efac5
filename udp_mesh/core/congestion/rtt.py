"""Round-trip time to one peer: a sample per acknowledgment -> smoothed, minimum and windowed RTT.

*Minimum* is the path without queues (over about 5 s). *Windowed* is the current round trip without single late
acknowledgments (minimum over half a round trip, at least 20 ms; longer on a path with jitter). Smoothed RTT and
variation follow RFC 6298.
"""

from collections import deque

MIN_RTT_WINDOW_S = 5.0
"""A longer window hides for that time that a route became longer; a shorter one forgets the empty path between two
drains."""

MIN_RTT_WINDOW_ROUND_TRIPS = 37.5
"""The same on long paths: 2.5 drains that are 15 round trips apart."""

MIN_WINDOWED_RTT_S = 0.020
"""Lower bound of the window: fast links acknowledge in bursts of a scheduler tick."""

MAX_JITTER_WINDOW_S = 0.06
JITTER_WINDOWS = 12.0
JITTER_PACKETS = 2.0
JITTER_GAIN = 1 / 64
"""The window covers so many times the mean deviation beyond the serialization time of a few packets, up to the former.
A radio that repeats a frame delays everything behind it by 10 to 30 ms, which fills the shorter window and looks like a
queue; a queue does not vanish within 60 ms. The mean is a slow one: a queue that builds up must not lengthen the window
that is to show it."""

INITIAL_PTO_S = 0.25
"""Until the first sample: the longest probe interval."""

MIN_PTO_ROUND_TRIPS = 2.0
"""An acknowledgment is always awaited for so many round trips: retransmitting everything before it can arrive would
keep a slow path slow."""

MAX_RTT_OUTLIER_S = 2.0
"""A longer sample that is also more than twice the usual is clamped: a process or machine suspended in between would
otherwise look like a path on which one packet every few seconds suffices."""

TIMER_GRANULARITY_S = 0.005
"""Added to timeouts: drivers and radios are late by this much without any loss."""


class RttEstimator:
    """All times in seconds; None before the first sample."""

    __slots__ = (
        "_jitter_s",
        "_min_samples",
        "_windowed_samples",
        "latest_rtt",
        "min_rtt",
        "packet_s",
        "rttvar",
        "smoothed_rtt",
        "windowed_rtt",
    )

    def __init__(self) -> None:
        self.smoothed_rtt: float | None = None
        self.rttvar = 0.0
        self._jitter_s = 0.0
        self.packet_s = 0.0
        """Serialization time of a packet, as far as known."""
        self.latest_rtt: float | None = None
        self.min_rtt: float | None = None
        self.windowed_rtt: float | None = None
        self._min_samples: deque[tuple[float, float]] = deque()
        self._windowed_samples: deque[tuple[float, float]] = deque()

    def restart_smoothed(self) -> None:
        """The next sample is the first of the smoothed RTT and its variation; minimum and window stay."""
        self.smoothed_rtt = None

    def sample(self, round_trip_s: float, now: float) -> None:
        """Add a measured round trip, without the time the peer held its acknowledgment back."""
        round_trip_s = min(round_trip_s, max(MAX_RTT_OUTLIER_S, 2 * (self.smoothed_rtt or 0.0)))
        self.latest_rtt = round_trip_s
        if self.smoothed_rtt is None:
            self.smoothed_rtt = round_trip_s
            self.rttvar = round_trip_s / 2
        else:
            deviation_s = abs(self.smoothed_rtt - round_trip_s)
            self.rttvar += (deviation_s - self.rttvar) / 4
            self._jitter_s += JITTER_GAIN * (deviation_s - self._jitter_s)
            self.smoothed_rtt += (round_trip_s - self.smoothed_rtt) / 8
        min_window_s = max(MIN_RTT_WINDOW_S, MIN_RTT_WINDOW_ROUND_TRIPS * (self.min_rtt or 0.0))
        self.min_rtt = _minimum(self._min_samples, round_trip_s, now, min_window_s)
        jitter_s = self._jitter_s - JITTER_PACKETS * self.packet_s
        jitter_window_s = min(MAX_JITTER_WINDOW_S, JITTER_WINDOWS * jitter_s)
        window_s = max(MIN_WINDOWED_RTT_S, self.smoothed_rtt / 2, jitter_window_s)
        self.windowed_rtt = _minimum(self._windowed_samples, round_trip_s, now, window_s)

    def reset_min_rtt(self, round_trip_s: float, now: float) -> None:
        """Replace the minimum RTT: the path changed."""
        self._min_samples.clear()
        self._min_samples.append((now, round_trip_s))
        self.min_rtt = round_trip_s

    def pto_s(self, ack_delay_s: float, max_s: float = float("inf")) -> float:
        """Probe timeout (RFC 9002, 6.2): time after the last progress in which the oldest packet or its acknowledgment
        must have been lost; at most `max_s` on a path that is not itself slow."""
        if self.smoothed_rtt is None:
            return min(max_s, INITIAL_PTO_S)
        timeout_s = self.smoothed_rtt + max(4 * self.rttvar, TIMER_GRANULARITY_S) + ack_delay_s
        return min(timeout_s, max(max_s, MIN_PTO_ROUND_TRIPS * self.smoothed_rtt))


def _minimum(samples: deque[tuple[float, float]], value: float, now: float, window_s: float) -> float:
    """Add `value` to a sliding minimum and return the minimum of the window. Amortized constant time."""
    while samples and samples[-1][1] >= value:
        samples.pop()
    samples.append((now, value))
    while samples[0][0] < now - window_s:
        samples.popleft()
    return samples[0][1]
