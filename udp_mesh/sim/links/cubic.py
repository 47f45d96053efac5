"""CUBIC congestion control of a foreign TCP flow, as in RFC 9438 (section numbers below).

Slow start is that of RFC 5681, without HyStart++; fast convergence (4.7) and the Reno-friendly region (4.3) are
modeled, spurious timeouts (4.9.2) are not.
"""

from __future__ import annotations

from udp_mesh.sim.links.tcp import INITIAL_CWND, AckSample

BETA = 0.7
"""4.6."""

C = 0.4
"""5."""

RENO_ALPHA = 3 * (1 - BETA) / (1 + BETA)
"""4.3."""

MIN_SSTHRESH = 2.0


class Cubic:
    """Windows in segments."""

    def __init__(self) -> None:
        self.cwnd = INITIAL_CWND
        self._ssthresh = float("inf")
        self._w_max = 0.0
        self._prior_cwnd = 0.0
        self._epoch_at: float | None = None
        self._k_s = 0.0
        self._reno_cwnd = 0.0
        self._rtt_s = 0.0

    def pacing_rate(self) -> float | None:
        return None

    def on_ack(self, sample: AckSample) -> None:
        if sample.rtt_s is not None:
            self._rtt_s = sample.rtt_s if not self._rtt_s else self._rtt_s + (sample.rtt_s - self._rtt_s) / 8
        if self.cwnd < self._ssthresh:
            self.cwnd += sample.acked
            return
        if self._epoch_at is None:
            self._begin_epoch(sample.now)
        assert self._epoch_at is not None
        since_s = sample.now - self._epoch_at
        # 4.2: the window one round trip ahead, growing by at most a half per round trip.
        ahead = C * (since_s + self._rtt_s - self._k_s) ** 3 + self._w_max
        target = min(max(ahead, self.cwnd), 1.5 * self.cwnd)
        alpha = RENO_ALPHA if self._reno_cwnd < self._prior_cwnd else 1.0
        self._reno_cwnd += alpha * sample.acked / self.cwnd
        if C * (since_s - self._k_s) ** 3 + self._w_max < self._reno_cwnd:
            self.cwnd = max(self.cwnd, self._reno_cwnd)
        else:
            self.cwnd += (target - self.cwnd) / self.cwnd * sample.acked

    def _begin_epoch(self, now: float) -> None:
        self._epoch_at = now
        self._reno_cwnd = self.cwnd
        self._w_max = max(self._w_max, self.cwnd)
        self._k_s = ((self._w_max - self.cwnd) / C) ** (1 / 3)

    def on_loss(self, now: float, in_flight: int) -> None:
        # 4.7: release bandwidth faster if the window has not come back to its last maximum.
        self._w_max = self.cwnd * (1 + BETA) / 2 if self.cwnd < self._w_max else self.cwnd
        self._prior_cwnd = self.cwnd
        self.cwnd = self._ssthresh = max(MIN_SSTHRESH, self.cwnd * BETA)
        self._epoch_at = None

    def on_timeout(self, now: float) -> None:
        self.on_loss(now, 0)
        self.cwnd = 1.0
