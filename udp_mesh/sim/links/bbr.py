"""BBR congestion control of a foreign TCP flow.

This is version 1, as in draft-cardwell-iccrg-bbr-congestion-control-00 (section numbers below) and in Linux.

The model of the path is the maximum delivery rate of ten round trips and the minimum round trip of ten seconds. Not
modeled: long-term sampling of token-bucket policers, packet conservation in the first round trip of a recovery.
"""

from __future__ import annotations

import random
from collections import deque
from enum import Enum

from udp_mesh.sim.links.tcp import INITIAL_CWND, AckSample

HIGH_GAIN = 2.885
"""2 / ln 2 (4.3.2.1)."""

CYCLE_GAINS = (1.25, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
"""4.3.4.1."""

CWND_GAIN = 2.0
MIN_CWND = 4.0
RATE_ROUNDS = 10
MIN_RTT_VALID_S = 10.0
PROBE_RTT_S = 0.2
FULL_GROWTH = 1.25
FULL_ROUNDS = 3
QUANTUM = 3.0
"""Segments added to the window for delayed and aggregated acknowledgments (4.2.3.2)."""


class _Phase(Enum):
    STARTUP = 1
    DRAIN = 2
    PROBE_BW = 3
    PROBE_RTT = 4


class Bbr:
    """Windows in segments, rates in segments per second."""

    def __init__(self, rng: random.Random) -> None:
        self._rng = rng
        self.cwnd = INITIAL_CWND
        self._phase = _Phase.STARTUP
        self._rates: deque[tuple[int, float]] = deque()
        self._min_rtt_s = float("inf")
        self._min_rtt_at = 0.0
        self._round = 0
        self._round_ends_at = 0
        self._full_rate = 0.0
        self._full_rounds = 0
        self._cycle = 0
        self._cycle_at = 0.0
        self._has_loss = False
        self._probe_rtt_ends_at: float | None = None
        self._cwnd_before = INITIAL_CWND

    def _rate(self) -> float:
        return self._rates[0][1] if self._rates else 0.0

    def _bdp(self) -> float:
        return self._rate() * self._min_rtt_s if self._rates and self._min_rtt_s != float("inf") else INITIAL_CWND

    def _pacing_gain(self) -> float:
        match self._phase:
            case _Phase.STARTUP:
                return HIGH_GAIN
            case _Phase.DRAIN:
                return 1 / HIGH_GAIN
            case _Phase.PROBE_BW:
                return CYCLE_GAINS[self._cycle]
            case _Phase.PROBE_RTT:
                return 1.0

    def pacing_rate(self) -> float | None:
        rate = self._rate()
        if not rate:
            return None
        # Linux paces one percent slower, so that the queue does not grow.
        return 0.99 * self._pacing_gain() * rate

    def on_ack(self, sample: AckSample) -> None:
        begins_round = sample.delivered_at_send >= self._round_ends_at
        if begins_round:
            self._round += 1
            self._round_ends_at = sample.delivered
        self._add_rate(sample.rate)
        is_stale = sample.now > self._min_rtt_at + MIN_RTT_VALID_S
        if sample.rtt_s is not None and (sample.rtt_s <= self._min_rtt_s or is_stale):
            self._min_rtt_s, self._min_rtt_at = sample.rtt_s, sample.now
        if begins_round and self._phase is _Phase.STARTUP:
            self._check_full()
        if self._phase is _Phase.DRAIN and sample.in_flight <= self._bdp():
            self._enter_probe_bw(sample.now)
        if self._phase is _Phase.PROBE_BW:
            self._advance_cycle(sample)
        self._probe_rtt(sample, is_stale=is_stale, begins_round=begins_round)
        self._set_cwnd(sample)

    def _add_rate(self, rate: float | None) -> None:
        if rate is not None:
            while self._rates and self._rates[-1][1] <= rate:
                self._rates.pop()
            self._rates.append((self._round, rate))
        while self._rates and self._rates[0][0] < self._round - RATE_ROUNDS:
            self._rates.popleft()

    def _check_full(self) -> None:
        if self._rate() >= FULL_GROWTH * self._full_rate:
            self._full_rate, self._full_rounds = self._rate(), 0
            return
        self._full_rounds += 1
        if self._full_rounds >= FULL_ROUNDS:
            self._phase = _Phase.DRAIN

    def _enter_probe_bw(self, now: float) -> None:
        self._phase = _Phase.PROBE_BW
        # Any phase but the one that drains.
        self._cycle = self._rng.choice((0, 2, 3, 4, 5, 6, 7))
        self._cycle_at = now
        self._has_loss = False

    def _advance_cycle(self, sample: AckSample) -> None:
        elapsed = sample.now - self._cycle_at > self._min_rtt_s
        gain = CYCLE_GAINS[self._cycle]
        if gain > 1:
            advance = elapsed and (self._has_loss or sample.in_flight >= gain * self._bdp())
        elif gain < 1:
            advance = elapsed or sample.in_flight <= self._bdp()
        else:
            advance = elapsed
        if advance:
            self._cycle = (self._cycle + 1) % len(CYCLE_GAINS)
            self._cycle_at = sample.now
            self._has_loss = False

    def _probe_rtt(self, sample: AckSample, *, is_stale: bool, begins_round: bool) -> None:
        if is_stale and self._phase is not _Phase.PROBE_RTT:
            self._phase = _Phase.PROBE_RTT
            self._cwnd_before = self.cwnd
            self._probe_rtt_ends_at = None
        if self._phase is not _Phase.PROBE_RTT:
            return
        if self._probe_rtt_ends_at is None:
            if sample.in_flight <= MIN_CWND:
                self._probe_rtt_ends_at = sample.now + PROBE_RTT_S
                self._round_ends_at = sample.delivered
        elif begins_round and sample.now >= self._probe_rtt_ends_at:
            self._min_rtt_at = sample.now
            self.cwnd = max(self.cwnd, self._cwnd_before)
            if self._full_rounds >= FULL_ROUNDS:
                self._enter_probe_bw(sample.now)
            else:
                self._phase = _Phase.STARTUP

    def _set_cwnd(self, sample: AckSample) -> None:
        gain = HIGH_GAIN if self._phase in (_Phase.STARTUP, _Phase.DRAIN) else CWND_GAIN
        target = gain * self._bdp() + QUANTUM
        if self._full_rounds >= FULL_ROUNDS:
            self.cwnd = min(self.cwnd + sample.acked, target)
        elif self.cwnd < target or sample.delivered < INITIAL_CWND:
            self.cwnd += sample.acked
        self.cwnd = max(self.cwnd, MIN_CWND)
        if self._phase is _Phase.PROBE_RTT:
            self.cwnd = min(self.cwnd, MIN_CWND)

    def on_loss(self, now: float, in_flight: int) -> None:
        self._has_loss = True

    def on_timeout(self, now: float) -> None:
        self._cwnd_before = max(self._cwnd_before, self.cwnd)
        self.cwnd = MIN_CWND
