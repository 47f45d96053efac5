"""Many points over time -> few: the mean of each equal bin, with its least and greatest value, so that a short peak
stays visible."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

Point = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Bins:
    """`count` equal bins from 0 on."""

    width_s: float
    count: int

    @classmethod
    def at_most(cls, count: int, end_s: float) -> Bins:
        """Bins of a round number of seconds up to `end_s`: others would beat with the periods of messages."""
        least_s = max(end_s / count, 1e-3)
        decade = 10 ** math.floor(math.log10(least_s))
        width_s = next(
            width for width in (decade, 2 * decade, 5 * decade, 10 * decade) if width >= least_s * (1 - 1e-9)
        )
        return cls(width_s, max(1, math.ceil(end_s / width_s - 1e-9)))

    def of(self, t: float) -> int:
        return min(self.count - 1, int(t / self.width_s))

    def times_s(self, started_s: float) -> list[float]:
        """The bins' middles, as Unix time."""
        return [round(started_s + (place + 0.5) * self.width_s, 3) for place in range(self.count)]


@dataclass(slots=True)
class _Bin:
    total: float = 0.0
    values: int = 0
    low: float = float("inf")
    high: float = float("-inf")

    def add(self, value: float) -> None:
        self.total += value
        self.values += 1
        self.low, self.high = min(self.low, value), max(self.high, value)


@dataclass(slots=True)
class BinnedLines:
    """One line per label; `add` points in any order."""

    bins: Bins
    _lines: dict[str, dict[int, _Bin]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(_Bin)))

    def add(self, label: str, t: float, value: float) -> None:
        self._lines[label][self.bins.of(t)].add(value)

    def series(self, labels: Iterable[str] | None = None) -> list[dict[str, Any]]:
        """`{label, values, low, high}` of each line; a bin without points is None. `low` and `high` are left out if
        no bin has several values."""
        found = []
        for label in sorted(self._lines) if labels is None else labels:
            filled = self._lines[label]
            places = [filled.get(place) for place in range(self.bins.count)]
            one: dict[str, Any] = {
                "label": label,
                "values": [None if each is None else rounded(each.total / each.values) for each in places],
            }
            if any(each.values > 1 and each.high > each.low for each in filled.values()):
                one["low"] = [None if each is None else rounded(each.low) for each in places]
                one["high"] = [None if each is None else rounded(each.high) for each in places]
            found.append(one)
        return found

    def labels(self, limit: int) -> tuple[list[str], int]:
        """The lines with the greatest values, at most `limit`, by name; and how many there are in all."""

        def greatest(label: str) -> float:
            return max(each.high for each in self._lines[label].values())

        chosen = sorted(self._lines, key=lambda label: (-greatest(label), label))[:limit]
        return sorted(chosen), len(self._lines)


def rounded(value: float) -> float:
    """With four digits, which a chart cannot tell from more."""
    return float(f"{value:.4g}")


def largest(totals: Mapping[str, float], limit: int) -> list[str]:
    """The names with the largest totals, at most `limit`."""
    return sorted(totals, key=lambda name: (-totals[name], name))[:limit]


def thinned(items: Sequence[Any], limit: int) -> list[Any]:
    """At most `limit` of the items at even distances, the first and the last among them."""
    if len(items) <= limit:
        return list(items)
    return [items[round(place * (len(items) - 1) / (limit - 1))] for place in range(limit)]
