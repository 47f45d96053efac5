"""The positions that a udp_mesh daemon knows: its `status` -> `PositionFacts`. Pure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class PositionFacts:
    """Where a robot is, in meters in the coordinate frame `frame`; `source` is `api`, `configuration` or `peer`."""

    name: str
    x_m: float
    y_m: float
    z_m: float | None
    frame: str
    age_s: float
    source: str


def positions_in(status: Mapping[str, Any]) -> tuple[PositionFacts, ...]:
    """The daemon's own position first; none for older daemons. Entries of other forms are left out."""
    entries = status.get("positions")
    found = (_position(entry) for entry in (entries if isinstance(entries, list) else ()))
    return tuple(position for position in found if position is not None)


def _position(entry: object) -> PositionFacts | None:
    if not isinstance(entry, dict):
        return None
    x_m, y_m, z_m, age_s = (_number(entry.get(key)) for key in ("x_m", "y_m", "z_m", "age_s"))
    if x_m is None or y_m is None or age_s is None:
        return None
    name, frame, source = (str(entry.get(key, "")) for key in ("name", "frame", "source"))
    return PositionFacts(name, x_m, y_m, z_m, frame, age_s, source)


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None
