"""The radio in a recording: `radio` of its conditions and of their peers -> samples -> how each radio path was.

Written if a collector reports to the daemon (docs/local-api.md): `radio` of a peer is null or has `radio`, `next_hop`,
`signal_dbm`, `margin_db`, `bottleneck_bits_per_s` and `trend`; that of the conditions null or `problem`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from udp_mesh.report.fields import UnreadableError, number, text

MAX_DECIBELS = 1000.0
MAX_BITS_PER_S = 1e12
WORSENING = "worsening"


@dataclass(frozen=True, slots=True)
class RadioSample:
    """The radio path to a peer; None is unknown."""

    t: float
    peer: str
    radio: str
    next_hop: str
    signal_dbm: float | None
    margin_db: float | None
    bottleneck_bits_per_s: float | None
    is_worsening: bool


@dataclass(slots=True)
class RadioPathUse:
    """The radio path to a peer during the recording."""

    samples: int = 0
    worsening: int = 0
    """Samples in which the signal was falling."""
    changes: int = 0
    """Of the next hop, or of the radio."""
    margins: int = 0
    """Samples with a known margin."""
    total_margin_db: float = 0.0
    least_margin_db: float | None = None
    least_bottleneck_bits_per_s: float | None = None
    last: RadioSample | None = None

    def add(self, sample: RadioSample) -> None:
        last, self.last = self.last, sample
        self.samples += 1
        self.worsening += sample.is_worsening
        self.changes += last is not None and (last.radio, last.next_hop) != (sample.radio, sample.next_hop)
        if sample.margin_db is not None:
            self.margins += 1
            self.total_margin_db += sample.margin_db
            self.least_margin_db = _least(self.least_margin_db, sample.margin_db)
        if sample.bottleneck_bits_per_s is not None:
            self.least_bottleneck_bits_per_s = _least(self.least_bottleneck_bits_per_s, sample.bottleneck_bits_per_s)

    @property
    def mean_margin_db(self) -> float | None:
        return self.total_margin_db / self.margins if self.margins else None

    @property
    def worsening_share(self) -> float:
        """The share of samples in which the signal was falling."""
        return self.worsening / self.samples if self.samples else 0.0


def _least(known: float | None, value: float) -> float:
    return value if known is None else min(known, value)


def radio_sample(t: float, peer: str, entry: object) -> RadioSample | None:
    """The sample in a peer's `radio`; None if nothing is known. Raises UnreadableError."""
    if entry is None:
        return None
    if not isinstance(entry, dict):
        raise UnreadableError("an object as radio", entry)
    trend = entry.get("trend")
    return RadioSample(
        *(t, peer, text(entry, "radio"), text(entry, "next_hop")),
        _known(entry, "signal_dbm", -MAX_DECIBELS, MAX_DECIBELS),
        _known(entry, "margin_db", -MAX_DECIBELS, MAX_DECIBELS),
        _known(entry, "bottleneck_bits_per_s", 0.0, MAX_BITS_PER_S),
        isinstance(trend, dict) and trend.get("direction") == WORSENING,
    )


def radio_problem(entry: object) -> str:
    """Why a radio gave no new values, from the conditions' `radio`; empty if it did, or nothing is known."""
    if entry is None:
        return ""
    if not isinstance(entry, dict):
        raise UnreadableError("an object as radio", entry)
    return "" if entry.get("problem") is None else text(entry, "problem")


def _known(entry: dict[str, Any], key: str, least: float, most: float) -> float | None:
    return None if entry.get(key) is None else number(entry, key, least, most)
