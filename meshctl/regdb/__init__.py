"""What a country allows on the air, from the kernel's wireless regulatory database.

`load` reads the machine's database (or the one shipped here), `Regdb.country` gives a country's rules, `judge` holds a
channel of a width against them.
"""

from meshctl.regdb.binary import RegdbError, decode
from meshctl.regdb.channels import CHANNELS, Span, center_mhz, channel_at, occupied, width_mhz
from meshctl.regdb.file import SHIPPED, SYSTEM, load, shipped_version
from meshctl.regdb.legality import Verdict, judge, legal_channels, primary
from meshctl.regdb.values import Country, DfsRegion, Flag, Regdb, Rule

__all__ = [
    "CHANNELS",
    "SHIPPED",
    "SYSTEM",
    "Country",
    "DfsRegion",
    "Flag",
    "Regdb",
    "RegdbError",
    "Rule",
    "Span",
    "Verdict",
    "center_mhz",
    "channel_at",
    "decode",
    "judge",
    "legal_channels",
    "load",
    "occupied",
    "primary",
    "shipped_version",
    "width_mhz",
]
