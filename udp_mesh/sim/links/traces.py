"""Quantities that change in steps over time: the rate, delay or MTU of a link, and generators of typical courses.

A course depends on the seed alone, so that the same link can be measured before and after a change.
"""

from __future__ import annotations

import random
from bisect import bisect_right
from dataclasses import dataclass
from itertools import pairwise

WIFI_RATES = (1e6, 2e6, 5.5e6, 6e6, 9e6, 11e6, 12e6, 18e6, 24e6, 36e6, 48e6, 54e6)
"""Bit rates of IEEE 802.11b and 802.11g."""

FADE_EVERY_S = (4.0, 10.0)
FADE_S = (0.1, 0.5)
"""A radio behind a corner or a passing vehicle: some tenths of a second without any frame."""

HANDOVER_EVERY_S = (6.0, 9.0)

REROUTED_DELAYS_S = (0.005, 0.075)
"""One-way delays of the two routes between which `handovers` changes: round trips of 10 and 150 ms."""


@dataclass(frozen=True, slots=True)
class Steps:
    """`values[i]` holds from `times[i]` on; `times` starts with 0 and grows."""

    times: tuple[float, ...]
    values: tuple[float, ...]

    def __post_init__(self) -> None:
        if len(self.times) != len(self.values) or not self.times or self.times[0] != 0.0:
            raise ValueError(f"expected as many times as values, the first of them 0, found {self.times}")
        if any(later <= earlier for earlier, later in pairwise(self.times)):
            raise ValueError(f"expected growing times, found {self.times}")

    def at(self, now: float) -> float:
        return self.values[max(0, bisect_right(self.times, now) - 1)]

    def next_change(self, now: float) -> float | None:
        """When the value changes next."""
        index = bisect_right(self.times, now)
        return self.times[index] if index < len(self.times) else None

    def integral(self, since: float, until: float) -> float:
        """Value times seconds between two times."""
        edges = [since, *(time for time in self.times if since < time < until), until]
        return sum(self.at(start) * (end - start) for start, end in pairwise(edges))

    def spans_of(self, value: float) -> list[tuple[float, float]]:
        """The intervals in which it has this value."""
        ends = (*self.times[1:], float("inf"))
        return [(start, end) for start, end, held in zip(self.times, ends, self.values, strict=True) if held == value]


def constant(value: float) -> Steps:
    return Steps((0.0,), (value,))


def wifi_rate_walk(seed: int, duration_s: float) -> Steps:
    """A random walk of a radio's rate control over the rates of 802.11, interrupted by fades (rate 0)."""
    rng = random.Random(f"rate walk {seed}")
    index = rng.randrange(4, len(WIFI_RATES))
    now, fade_at = 0.0, rng.uniform(*FADE_EVERY_S)
    times, values = [0.0], [WIFI_RATES[index]]
    while now < duration_s:
        step_at = now + rng.uniform(0.5, 2.5)
        if step_at > fade_at:
            returns_at = fade_at + rng.uniform(*FADE_S)
            times += [fade_at, returns_at]
            values += [0.0, WIFI_RATES[index]]
            now, fade_at = returns_at, returns_at + rng.uniform(*FADE_EVERY_S)
            continue
        now = step_at
        index = min(len(WIFI_RATES) - 1, max(0, index + rng.choice((-1, 1))))
        if WIFI_RATES[index] != values[-1]:
            times.append(now)
            values.append(WIFI_RATES[index])
    return Steps(tuple(times), tuple(values))


def handovers(seed: int, duration_s: float) -> Steps:
    """One-way delay of a route that changes between a short and a long one."""
    rng = random.Random(f"handovers {seed}")
    now, long = 0.0, False
    times, values = [0.0], [REROUTED_DELAYS_S[0]]
    while (now := now + rng.uniform(*HANDOVER_EVERY_S)) < duration_s:
        long = not long
        times.append(now)
        values.append(REROUTED_DELAYS_S[long])
    return Steps(tuple(times), tuple(values))


def mtu_hole(from_s: float, mtu: int, wide_mtu: int = 1500) -> Steps:
    """A path that carries only small packets from a time on, without reporting it."""
    return Steps((0.0, from_s), (wide_mtu, mtu))
