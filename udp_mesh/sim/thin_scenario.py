"""`thin` of a scenario: the radios of thin links, with rate, frames, budget and range.

    thin:
      presence_s: 45
      links:
        lora: {bits_per_s: 5470, frame_bytes: 120, duty_cycle: 0.01, air: {good_m: 400, range_m: 1500}}

Every robot has each of these radios; robots are numbered in the order of the file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from udp_mesh.core.thin.settings import MAX_PRESENCE_S, MIN_PRESENCE_S, ThinLinkSettings, ThinSettings
from udp_mesh.sim.mobility import PathLoss
from udp_mesh.sim.yaml_entry import Entry

# Minimum and maximum of each number of `ThinLinkSettings`, in its unit; those in bytes are whole.
_RANGES = {
    "bits_per_s": (10.0, 1e6),
    "frame_bytes": (1.0, 255.0),
    "frame_overhead_bytes": (0.0, 1000.0),
    "frame_s": (0.0, 10.0),
    "duty_cycle": (1e-5, 1.0),
    "window_s": (1.0, 86_400.0),
    "max_airtime_s": (1e-3, 60.0),
}


@dataclass(frozen=True, slots=True)
class ThinRadio:
    """One thin link as all robots have it, and how far it reaches."""

    link: ThinLinkSettings
    air: PathLoss


@dataclass(frozen=True, slots=True)
class ThinRadios:
    """The thin links of a scenario."""

    radios: tuple[ThinRadio, ...] = ()
    presence_s: float = 45.0

    def settings(self, number: int) -> ThinSettings:
        """Those of the robot with this number."""
        return ThinSettings(number, tuple(radio.link for radio in self.radios), self.presence_s)


def read_thin(at: Entry, read_air: Callable[[Entry], PathLoss]) -> ThinRadios:
    """The scenario's entry `thin`; `read_air` reads a propagation model."""
    entries = at.mapping(("presence_s", "links"))
    radios = [
        _radio(name, entry, read_air)
        for name, entry in (entries["links"].mapping(None).items() if "links" in entries else ())
    ]
    presence_s = ThinSettings().presence_s
    if "presence_s" in entries:
        presence_s = entries["presence_s"].number(presence_s, MIN_PRESENCE_S, MAX_PRESENCE_S)
    return ThinRadios(tuple(radios), presence_s)


def _radio(name: str, at: Entry, read_air: Callable[[Entry], PathLoss]) -> ThinRadio:
    entries = at.mapping((*_RANGES, "air"))
    values: dict[str, Any] = {}
    for key, (low, high) in _RANGES.items():
        if key in entries:
            whole = key.endswith("_bytes")
            values[key] = entries[key].integer(1, int(low), int(high)) if whole else entries[key].number(low, low, high)
    air = read_air(entries["air"]) if "air" in entries else PathLoss()
    if "bits_per_s" not in entries:
        at.problem("the key bits_per_s", "none")
        return ThinRadio(ThinLinkSettings("unusable", 1000.0), air)
    try:
        return ThinRadio(ThinLinkSettings(name, **values), air)
    except ValueError as error:
        at.problem("a thin link that can work", str(error))
        return ThinRadio(ThinLinkSettings("unusable", 1000.0), air)
