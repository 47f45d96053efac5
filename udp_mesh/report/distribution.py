"""The distribution of values of at least 0, in bounded memory: exact for the first `MAX_EXACT` of them, then counted in
bins of a constant ratio, so that every figure is within 0.1 % of the exact one."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

MAX_EXACT = 2000
RATIO = 1.002
_LOG_RATIO = math.log(RATIO)
# What is smaller counts as this; no clock of a recording is finer.
_LEAST = 1e-7


@dataclass(slots=True)
class Distribution:
    """`count` values."""

    count: int = 0
    _exact: array[float] = field(default_factory=lambda: array("d"))
    _binned: dict[int, int] = field(default_factory=dict)

    @classmethod
    def of(cls, values: Iterable[float]) -> Distribution:
        found = cls()
        for value in values:
            found.add(value)
        return found

    def add(self, value: float) -> None:
        self.count += 1
        if not self._binned and self.count <= MAX_EXACT:
            self._exact.append(value)
            return
        for earlier in self._exact:
            self._bin(earlier)
        if self._exact:
            self._exact = array("d")
        self._bin(value)

    def _bin(self, value: float) -> None:
        place = round(math.log(max(value, _LEAST)) / _LOG_RATIO)
        self._binned[place] = self._binned.get(place, 0) + 1

    def ascending(self) -> Iterator[tuple[float, int]]:
        """(value, how many)."""
        if self._binned:
            for place in sorted(self._binned):
                yield math.exp(place * _LOG_RATIO), self._binned[place]
        else:
            for value in sorted(self._exact):
                yield value, 1

    def quantile(self, share: float) -> float | None:
        """The value that this share does not exceed; None without values."""
        rank = min(self.count - 1, int(share * self.count))
        below = 0
        for value, times in self.ascending():
            below += times
            if below > rank:
                return value
        return None
