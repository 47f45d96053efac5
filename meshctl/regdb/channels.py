"""Channels and the frequencies they occupy: numbers by IEEE 802.11-2020 annex E, widths by UCI's htmode.

`center_mhz` and `channel_at` convert a 20 MHz channel; `occupied_span` returns the whole range of a channel with an
htmode, or None if there is no such channel.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

from meshctl.model import Band

_2G_CHANNELS = tuple(range(1, 15))
_5G_CHANNELS = (*range(36, 65, 4), *range(100, 145, 4), *range(149, 178, 4))
CHANNELS = {Band.G2: _2G_CHANNELS, Band.G5: _5G_CHANNELS}

_HTMODE = re.compile(r"(?:HT|VHT|HE|EHT)(20|40|80|160)[+-]?")

# the lowest channel of every bonded group at 5 GHz, per width; 80 and 160 MHz bond fixed groups of 4 and 8
_GROUPS_40 = (36, 44, 52, 60, 100, 108, 116, 124, 132, 140, 149, 157, 165, 173)
_GROUPS_80 = (36, 52, 100, 116, 132, 149, 165)
_GROUPS_160 = (36, 100, 149)

# 2.4 GHz: the secondary channel is four numbers away; OpenWrt uses the upper one below channel 7
_HT40_STEP = 4
_HT40_UPPER_BELOW = 7


@dataclass(frozen=True, slots=True)
class Span:
    """A range of frequencies, `low_mhz` to `high_mhz`."""

    low_mhz: int
    high_mhz: int

    @property
    def width_mhz(self) -> int:
        return self.high_mhz - self.low_mhz

    def overlaps(self, other: Span) -> bool:
        return self.low_mhz < other.high_mhz and other.low_mhz < self.high_mhz


def center_mhz(band: Band, channel: int) -> int:
    """The center frequency of a 20 MHz channel. Raises ValueError for an unknown channel."""
    if channel not in CHANNELS[band]:
        raise ValueError(f"band {band.value} has no channel {channel}")
    if band is Band.G5:
        return 5000 + 5 * channel
    return 2484 if channel == 14 else 2407 + 5 * channel


def channel_at(mhz: int) -> tuple[Band, int] | None:
    """The 20 MHz channel centered at `mhz`, None if there is none."""
    if mhz == 2484:
        return Band.G2, 14
    band, base = (Band.G2, 2407) if mhz < 3000 else (Band.G5, 5000)
    channel, rest = divmod(mhz - base, 5)
    return (band, channel) if not rest and channel in CHANNELS[band] and channel != 14 else None


def width_mhz(htmode: str) -> int:
    """The width of an htmode (`HT20`, `HT40-`, `VHT80`, `HE40`, `NOHT`). Raises ValueError for an unknown one."""
    if htmode == "NOHT":
        return 20
    match = _HTMODE.fullmatch(htmode)
    if match is None:
        raise ValueError(f"unknown htmode {htmode}")
    return int(match[1])


def occupied_span(band: Band, channel: int, htmode: str) -> Span | None:
    """The range that a channel occupies with this htmode; None if they are incompatible (`HT40+` on 165, 80 MHz at
    2.4 GHz). Raises ValueError for an unknown channel or htmode."""
    width = width_mhz(htmode)
    center = center_mhz(band, channel)
    if width == 20:
        return Span(center - 10, center + 10)
    if band is Band.G2:
        return _bonded_2g(channel, htmode) if width == 40 and channel != 14 else None
    groups = {40: _GROUPS_40, 80: _GROUPS_80, 160: _GROUPS_160}[width]
    size = width // 20
    first = next((low for low in groups if low <= channel < low + 4 * size and low + 4 * (size - 1) <= 177), None)
    if first is None:
        return None
    # an explicit side must match the group
    if (htmode.endswith("+") and channel != first) or (htmode.endswith("-") and channel == first):
        return None
    low = center_mhz(band, first) - 10
    return Span(low, low + width)


def _bonded_2g(channel: int, htmode: str) -> Span | None:
    upper = htmode.endswith("+") or (not htmode.endswith("-") and channel < _HT40_UPPER_BELOW)
    secondary = channel + _HT40_STEP if upper else channel - _HT40_STEP
    if not 1 <= secondary <= 13:
        return None
    low = center_mhz(Band.G2, min(channel, secondary)) - 10
    return Span(low, low + 40)
