"""Airtime of LoRa frames with the presets of Meshtastic, as the straight line that the budget of a thin link uses.

Semtech AN1200.13: a frame has a preamble and 8 symbols, then groups of `coding` symbols with 4 (SF - 2 DE) bits each;
DE, the optimization for low data rates, is on where a symbol takes 16 ms. The line adds a group for the last one, which
need not be full: it is never below the true airtime, and at most one group above it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

PREAMBLE_SYMBOLS = 16 + 4.25
"""Meshtastic's `preambleLength`, and the sync word."""
_HEADER_SYMBOLS = 8
_FIXED_BITS = 28 + 16
"""Of the explicit header and the CRC."""
_LOW_RATE_SYMBOL_S = 0.016

MESHTASTIC_OVERHEAD_BYTES = 16 + 3 + 3 + 2
"""Meshtastic's header, then in `Data` the port number, tag and length of the payload, and the bit field."""


@dataclass(frozen=True, slots=True)
class LoraPreset:
    """Spreading factor, bandwidth, and symbols per group: 5 for a coding rate of 4/5, up to 8 for 4/8."""

    spreading: int
    bandwidth_hz: float
    coding: int

    @property
    def symbol_s(self) -> float:
        return 2.0**self.spreading / self.bandwidth_hz

    @property
    def group_bits(self) -> int:
        """Bits of a frame that one group of symbols carries."""
        return 4 * (self.spreading - 2 * (self.symbol_s >= _LOW_RATE_SYMBOL_S))

    @property
    def bits_per_s(self) -> float:
        """Slope of the line."""
        return self.group_bits / (self.coding * self.symbol_s)

    @property
    def frame_s(self) -> float:
        """The line at no bytes."""
        fixed = (_FIXED_BITS - 4 * self.spreading) / self.group_bits + 1
        return self.symbol_s * (PREAMBLE_SYMBOLS + _HEADER_SYMBOLS + self.coding * fixed)


PRESETS: Mapping[str, LoraPreset] = MappingProxyType(
    {
        "SHORT_TURBO": LoraPreset(7, 500e3, 5),
        "SHORT_FAST": LoraPreset(7, 250e3, 5),
        "SHORT_SLOW": LoraPreset(8, 250e3, 5),
        "MEDIUM_FAST": LoraPreset(9, 250e3, 5),
        "MEDIUM_SLOW": LoraPreset(10, 250e3, 5),
        "LONG_TURBO": LoraPreset(11, 500e3, 8),
        "LONG_FAST": LoraPreset(11, 250e3, 5),
        "LONG_MODERATE": LoraPreset(11, 125e3, 8),
        "LONG_SLOW": LoraPreset(12, 125e3, 8),
    }
)
"""Meshtastic's modem presets (its documentation, "LoRa configuration", "Presets")."""
