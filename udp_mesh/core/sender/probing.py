"""When and how much is sent to a peer that acknowledges nothing: probes, and bursts while it is heard.

A probe is one packet: every 25 ms in the first second, every 250 ms later. The first sign of life triggers a burst at
once. While nothing is acknowledged, the interval to the next burst doubles: the forward path may be down, or have a
queue of seconds that more bursts would keep full.
"""

FAST_PROBE_INTERVAL_S = 0.025
"""Probe interval in the first second: most outages of a moving robot are that short."""

PROBE_INTERVAL_S = 0.25
"""Probe interval later: the time lost when the link returns, at four packets a second to a dead peer."""

FAST_PROBE_FOR_S = 1.0

BURST_PACKETS = 10
"""Packets sent at once when an unresponsive peer is heard without acknowledging (the path to it may still be down)."""

MIN_BURST_INTERVAL_S = 0.1
MAX_BURST_INTERVAL_S = 3.2

_LEAST_INTERVAL_S = FAST_PROBE_INTERVAL_S * 0.99


class Probing:
    """Limits what is sent to an unresponsive peer. Times in seconds."""

    __slots__ = ("_began_at", "_burst_at", "_burst_interval_s", "_probed_at", "credit")

    def __init__(self) -> None:
        self.credit = 0
        """Packets that may still be sent of the last probe or burst."""
        self._began_at = float("-inf")
        self._probed_at = float("-inf")
        self._reset_bursts()

    def _reset_bursts(self) -> None:
        self._burst_at = float("-inf")
        self._burst_interval_s = MIN_BURST_INTERVAL_S

    def begin(self, now: float) -> None:
        """The peer has become unresponsive."""
        self._began_at = now

    def end(self) -> None:
        """The peer acknowledges again."""
        self.credit = 0
        self._reset_bursts()

    def next_at(self) -> float:
        """When the next probe is due."""
        is_fast = self._probed_at - self._began_at < FAST_PROBE_FOR_S
        return self._probed_at + (FAST_PROBE_INTERVAL_S if is_fast else PROBE_INTERVAL_S)

    def is_slow(self, now: float) -> bool:
        """Whether the peer has been unresponsive for so long that probes are sent at the longer interval."""
        return now - self._began_at > FAST_PROBE_FOR_S

    def allow_probe(self, now: float) -> bool:
        """Allow one packet. False within `FAST_PROBE_INTERVAL_S` of the last probe."""
        if now < self._probed_at + _LEAST_INTERVAL_S:
            return False
        self._probed_at = now
        self.credit = 1
        return True

    def allow_burst(self, now: float, window_packets: int) -> bool:
        """Allow a burst within the window, because the peer was heard. False if it comes too soon after the last one,
        or after a probe."""
        if now < max(self._burst_at, self._probed_at + _LEAST_INTERVAL_S):
            return False
        self._burst_at = now + self._burst_interval_s
        self._burst_interval_s = min(MAX_BURST_INTERVAL_S, 2 * self._burst_interval_s)
        self._probed_at = now
        self.credit = min(BURST_PACKETS, window_packets)
        return True
