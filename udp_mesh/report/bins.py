"""Many points over time -> few, in bounded memory: the mean of each equal bin, with its least and greatest value, so
that a short peak stays visible; and evenly thinned items."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

T = TypeVar("T")
MAX_LABELS = 256
"""Lines of one chart whose points are gathered; a chart shows fewer."""
_COARSER = 10
"""Bins are gathered so much finer than they are shown that they can be joined to any round number of seconds."""
_FINEST_DECADE = -3


@dataclass(frozen=True, slots=True)
class Bins:
    """`count` equal bins from 0 on."""

    width_s: float
    count: int

    @classmethod
    def at_most(cls, count: int, end_s: float) -> Bins:
        """Bins of a round number of seconds up to `end_s`: others would beat with the periods of messages."""
        least_s = max(end_s / count, 10.0**_FINEST_DECADE)
        decade = 10.0 ** math.floor(math.log10(least_s))
        width_s = next(
            width for width in (decade, 2 * decade, 5 * decade, 10 * decade) if width >= least_s * (1 - 1e-9)
        )
        return cls(width_s, max(1, math.ceil(end_s / width_s - 1e-9)))

    def times_s(self, started_s: float) -> list[float]:
        """The bins' middles, as Unix time."""
        return [round(started_s + (place + 0.5) * self.width_s, 3) for place in range(self.count)]


class _Columns:
    """Total, number, least and greatest of the values in each bin, up to the last one with a value."""

    __slots__ = ("high", "low", "numbers", "totals")

    def __init__(self) -> None:
        self.totals = array("d")
        self.numbers = array("L")
        self.low = array("f")
        self.high = array("f")

    def add(self, place: int, value: float) -> None:
        if place >= len(self.numbers):
            self._reach(place + 1)
        self.totals[place] += value
        self.numbers[place] += 1
        if value < self.low[place]:
            self.low[place] = value
        if value > self.high[place]:
            self.high[place] = value

    def joined(self, factor: int, count: int | None = None) -> _Columns:
        """With `factor` bins as one; what is beyond `count` bins is in the last one."""
        found = _Columns()
        for place, number in enumerate(self.numbers):
            if number:
                to = place // factor if count is None else min(count - 1, place // factor)
                found._reach(to + 1)
                found.totals[to] += self.totals[place]
                found.numbers[to] += number
                found.low[to] = min(found.low[to], self.low[place])
                found.high[to] = max(found.high[to], self.high[place])
        return found

    def _reach(self, count: int) -> None:
        missing = max(0, count - len(self.numbers))
        self.totals.extend([0.0] * missing)
        self.numbers.extend([0] * missing)
        self.low.extend([math.inf] * missing)
        self.high.extend([-math.inf] * missing)


@dataclass(slots=True)
class BinnedLines:
    """One line per label, at most `MAX_LABELS`; `add` points in any order. The memory of a line does not grow with its
    points: bins become coarser with time, and have at least a tenth of the width in which they are shown."""

    max_bins: int
    left_out: set[str] = field(default_factory=set)
    """Labels beyond the limit, themselves at most as many."""
    _decade: int = _FINEST_DECADE
    _lines: dict[str, _Columns] = field(default_factory=dict)

    def add(self, label: str, t: float, value: float) -> None:
        line = self._lines.get(label)
        if line is None:
            if len(self._lines) >= MAX_LABELS:
                if len(self.left_out) < MAX_LABELS:
                    self.left_out.add(label)
                return
            line = self._lines[label] = _Columns()
        place = int(t / 10.0**self._decade)
        if place >= self.max_bins * _COARSER:
            self._coarsen(t)
            line = self._lines[label]
            place = int(t / 10.0**self._decade)
        line.add(place, value)

    def _coarsen(self, t: float) -> None:
        before = self._decade
        while int(t / 10.0**self._decade) >= self.max_bins * _COARSER:
            self._decade += 1
        factor = 10 ** (self._decade - before)
        self._lines = {label: line.joined(factor) for label, line in self._lines.items()}

    def _shown(self, label: str, bins: Bins) -> _Columns:
        return self._lines[label].joined(max(1, round(bins.width_s / 10.0**self._decade)), bins.count)

    def series(self, bins: Bins, labels: Iterable[str]) -> list[dict[str, Any]]:
        """`{label, values, low, high}` of each line; a bin without points is None. `low` and `high` are left out if
        no bin has several values. `bins` are those `at_most` `max_bins` of the whole time."""
        found = []
        for label in labels:
            line = self._shown(label, bins)
            numbers = [*line.numbers, *([0] * (bins.count - len(line.numbers)))]
            entry: dict[str, Any] = {
                "label": label,
                "values": [rounded(line.totals[at] / number) if number else None for at, number in enumerate(numbers)],
            }
            if any(number > 1 and line.high[at] > line.low[at] for at, number in enumerate(numbers)):
                entry["low"] = [rounded(line.low[at]) if number else None for at, number in enumerate(numbers)]
                entry["high"] = [rounded(line.high[at]) if number else None for at, number in enumerate(numbers)]
            found.append(entry)
        return found

    def totals(self, bins: Bins, label: str) -> list[float]:
        """The sum of a line's values in each bin; 0 without any."""
        totals = self._shown(label, bins).totals if label in self._lines else ()
        return [*totals, *([0.0] * (bins.count - len(totals)))]

    def labels(self, limit: int) -> tuple[list[str], int]:
        """The lines with the greatest values, at most `limit`, by name; and how many there are in all."""

        def greatest(label: str) -> float:
            return max(self._lines[label].high)

        chosen = sorted(self._lines, key=lambda label: (-greatest(label), label))[:limit]
        return sorted(chosen), len(self._lines)


class Thinned(Generic[T]):
    """At most twice `limit` of the items that were added, at even distances, the first and the last among them;
    `count` were added."""

    __slots__ = ("_kept", "_last", "_limit", "_stride", "count")

    def __init__(self, limit: int) -> None:
        self.count = 0
        self._limit = limit
        self._stride = 1
        self._kept: list[T] = []
        self._last: list[T] = []

    def add(self, item: T) -> None:
        if self.count % self._stride == 0:
            if len(self._kept) == 2 * self._limit:
                self._kept = self._kept[::2]
                self._stride *= 2
            if self.count % self._stride == 0:
                self._kept.append(item)
        self._last = [item]
        self.count += 1

    def items(self, limit: int | None = None) -> list[T]:
        """At most `limit` of them."""
        has_last = not self.count or (self.count - 1) % self._stride == 0
        return thinned([*self._kept, *([] if has_last else self._last)], self._limit if limit is None else limit)


def rounded(value: float) -> float:
    """With four digits, which a chart cannot tell from more."""
    return float(f"{value:.4g}")


def largest(totals: Mapping[str, float], limit: int) -> list[str]:
    """The names with the largest totals, at most `limit`."""
    return sorted(totals, key=lambda name: (-totals[name], name))[:limit]


def thinned(items: Sequence[T], limit: int) -> list[T]:
    """At most `limit` of the items at even distances, the first and the last among them."""
    if len(items) <= limit:
        return list(items)
    if limit < 2:
        return list(items[:limit])
    return [items[round(place * (len(items) - 1) / (limit - 1))] for place in range(limit)]
