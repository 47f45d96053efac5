"""Regulatory rules of countries, from the kernel's wireless regulatory database.

`load` reads the system database, or the copy shipped here; `Regdb.country` returns a country's rules; `check_span`
checks a channel of a given width against them.
"""

from meshctl.regdb.binary import RegdbError, decode
from meshctl.regdb.channels import CHANNELS, Span, center_mhz, channel_at, occupied_span, width_mhz
from meshctl.regdb.file import SHIPPED, SYSTEM, load, shipped_version
from meshctl.regdb.legality import (
    NO_INITIATE,
    Legality,
    check_span,
    initiating_channels,
    legal_channels,
    primary_span,
)
from meshctl.regdb.values import Country, DfsRegion, Flag, FrequencyRule, Regdb

__all__ = [
    "CHANNELS",
    "NO_INITIATE",
    "SHIPPED",
    "SYSTEM",
    "Country",
    "DfsRegion",
    "Flag",
    "FrequencyRule",
    "Legality",
    "Regdb",
    "RegdbError",
    "Span",
    "center_mhz",
    "channel_at",
    "check_span",
    "decode",
    "initiating_channels",
    "legal_channels",
    "load",
    "occupied_span",
    "primary_span",
    "shipped_version",
    "width_mhz",
]
