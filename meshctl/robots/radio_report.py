"""The links that a robot's radios measure -> the report that its daemon adds to its conditions. Pure.

`RadioTracker.take` gets each table of a radio, `report` gives the payload of the daemon's request `set-radio`
(docs/local-api.md). Only the robot's own radios are asked, so that a margin is that of its next hop, in the direction
that the robot hears; of the hops behind it only the routing protocol's measure of the whole path is known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from meshctl.device.link_table import LinkTable
from meshctl.placement.margin import (
    DEFAULT_NOISE_DBM,
    MAX_SHARED_HOPS,
    Sample,
    fade_allowance_db,
    filtered_snr_db,
    rate_mbit_s,
    required_snr_db,
)

KEPT_S = 30.0
"""Older tables and samples are ignored."""
MIN_TREND_S = 10.0
MIN_TREND_SAMPLES = 6
MIN_CHANGE_DB_PER_S = 0.1
"""A smaller change is steady: 3 dB in half a minute."""
TREND_ERRORS = 2.0
"""A change within so many standard errors is fading."""
MAX_NEIGHBORS = 64
"""The strongest ones."""
_MAX_SAMPLES = 120
_MAX_TQ = 255


@dataclass(frozen=True, slots=True)
class Names:
    """`nodes`: MAC -> node; `robots`: robot -> its radios, without the robot itself."""

    nodes: Mapping[str, str]
    robots: Mapping[str, tuple[str, ...]]


@dataclass(frozen=True, slots=True)
class _Path:
    """`measured_mbit_s` and `quality` are the routing protocol's, of the whole path; `rank` compares paths."""

    radio: str
    next_hop: str
    measured_mbit_s: float | None
    quality: float | None
    rank: tuple[float, float]


@dataclass(slots=True)
class RadioTracker:
    """The tables and samples of all radios of a robot. Times are of one monotonic clock."""

    load_mbit_s: float
    _tables: dict[str, LinkTable] = field(default_factory=dict)
    _samples: dict[tuple[str, str], deque[Sample]] = field(default_factory=dict)

    def take(self, radio: str, table: LinkTable) -> None:
        """A new table of a radio, once."""
        self._tables[radio] = table
        for mac, signal_dbm in table.signals_dbm.items():
            kept = self._samples.setdefault((radio, mac), deque(maxlen=_MAX_SAMPLES))
            kept.append(Sample(table.taken_s, signal_dbm - _noise_dbm(table, mac), 0.0))
        for key, kept in list(self._samples.items()):
            while kept and table.taken_s - kept[0].at_s > KEPT_S:
                kept.popleft()
            if not kept:
                del self._samples[key]

    def report(self, names: Names, source: str, problem: str, now_s: float) -> dict[str, Any]:
        """The payload of `set-radio`."""
        tables = {radio: table for radio, table in self._tables.items() if now_s - table.taken_s <= KEPT_S}
        paths = ((robot, self._best(nodes, names, tables)) for robot, nodes in names.robots.items())
        return {
            "source": source,
            "problem": problem,
            "paths": [self._path(robot, path, names, now_s) for robot, path in paths if path is not None],
            "neighbors": self._neighbors(names, tables, now_s),
        }

    def _best(self, nodes: tuple[str, ...], names: Names, tables: Mapping[str, LinkTable]) -> _Path | None:
        """The path with the best measure of all radios, regardless of the one that the bridge between them uses."""
        found = [path for radio, table in tables.items() for path in _paths(radio, table, nodes, names.nodes)]
        return max(found, key=lambda path: path.rank, default=None)

    def _path(self, robot: str, path: _Path, names: Names, now_s: float) -> dict[str, Any]:
        table = self._tables[path.radio]
        samples = tuple(self._samples[path.radio, path.next_hop])
        expected_mbit_s = table.expected_mbit_s.get(path.next_hop)
        hop_mbit_s = rate_mbit_s(filtered_snr_db(samples)) if expected_mbit_s is None else expected_mbit_s
        measured = path.measured_mbit_s
        change_db_per_s = slope_db_per_s(samples)
        return {
            "peer": robot,
            "radio": path.radio,
            "next_hop": names.nodes.get(path.next_hop, path.next_hop),
            "age_s": round(max(0.0, now_s - table.taken_s), 3),
            "signal_dbm": table.signals_dbm[path.next_hop],
            "noise_dbm": table.noise_dbm.get(path.next_hop),
            "margin_db": self._margin_db(samples),
            "bottleneck_bits_per_s": round(1e6 * (hop_mbit_s if measured is None else min(hop_mbit_s, measured))),
            "quality": path.quality,
            "trend": None if change_db_per_s is None else direction(change_db_per_s),
            "change_db_per_s": None if change_db_per_s is None else round(change_db_per_s, 3),
        }

    def _neighbors(self, names: Names, tables: Mapping[str, LinkTable], now_s: float) -> list[dict[str, Any]]:
        heard = sorted(
            ((dbm, radio, mac) for radio, table in tables.items() for mac, dbm in table.signals_dbm.items()),
            reverse=True,
        )
        return [
            {
                "name": names.nodes.get(mac, mac),
                "radio": radio,
                "age_s": round(max(0.0, now_s - tables[radio].taken_s), 3),
                "signal_dbm": dbm,
                "margin_db": self._margin_db(tuple(self._samples[radio, mac])),
            }
            for dbm, radio, mac in heard[:MAX_NEIGHBORS]
        ]

    def _margin_db(self, samples: tuple[Sample, ...]) -> float:
        needed_db = required_snr_db(self.load_mbit_s, MAX_SHARED_HOPS)
        return round(filtered_snr_db(samples) - needed_db - fade_allowance_db(samples), 1)


def _paths(radio: str, table: LinkTable, nodes: Iterable[str], names: Mapping[str, str]) -> Iterator[_Path]:
    """One radio's paths to these nodes: by its routing table, or directly where it has none."""
    wanted = frozenset(nodes)
    if table.paths is None:
        for mac, dbm in table.signals_dbm.items():
            if names.get(mac) in wanted:
                yield _Path(radio, mac, None, None, (0.0, float(dbm)))
        return
    for row in table.paths:
        # a next hop that is not heard is the robot's other radio, across its switch: that one has the path itself
        if row.best and names.get(row.mac) in wanted and row.next_hop in table.signals_dbm:
            mbit_s = None if row.throughput_kbit_s is None else row.throughput_kbit_s / 1000
            quality = None if row.tq is None else round(row.tq / _MAX_TQ, 3)
            rank = (mbit_s or quality or 0.0, float(table.signals_dbm[row.next_hop]))
            yield _Path(radio, row.next_hop, mbit_s, quality, rank)


def _noise_dbm(table: LinkTable, mac: str) -> float:
    noise_dbm = table.noise_dbm.get(mac)
    return DEFAULT_NOISE_DBM if noise_dbm is None else noise_dbm


def slope_db_per_s(samples: tuple[Sample, ...]) -> float | None:
    """The least-squares change of the signal, 0 within the error of the fit; None if too little was measured."""
    if len(samples) < MIN_TREND_SAMPLES or samples[-1].at_s - samples[0].at_s < MIN_TREND_S:
        return None
    count = len(samples)
    center_s = sum(sample.at_s for sample in samples) / count
    mean_db = sum(sample.snr_db for sample in samples) / count
    spread = sum((sample.at_s - center_s) ** 2 for sample in samples)
    slope = sum((sample.at_s - center_s) * (sample.snr_db - mean_db) for sample in samples) / spread
    rest = sum((sample.snr_db - mean_db - slope * (sample.at_s - center_s)) ** 2 for sample in samples)
    error = math.sqrt(rest / (count - 2) / spread)
    return slope if abs(slope) > TREND_ERRORS * error else 0.0


def direction(change_db_per_s: float) -> str:
    """In the daemon's words."""
    if abs(change_db_per_s) < MIN_CHANGE_DB_PER_S:
        return "steady"
    return "improving" if change_db_per_s > 0 else "worsening"
