"""A regulatory database as frozen values: countries and their rules."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, IntFlag


class Flag(IntFlag):
    """Restrictions of a rule, as in the kernel (net/wireless/reg.c, enum fwdb_flags)."""

    NO_OFDM = 1
    NO_OUTDOOR = 2
    DFS = 4
    NO_IR = 8
    AUTO_BW = 16


NO_FLAGS = Flag(0)


class DfsRegion(Enum):
    """The radar detection rules of a country (enum nl80211_dfs_regions)."""

    UNSET = 0
    FCC = 1
    ETSI = 2
    JP = 3


@dataclass(frozen=True, slots=True)
class FrequencyRule:
    """One frequency range: its edges, maximum bandwidth, maximum power and restrictions."""

    start_khz: int
    end_khz: int
    max_bandwidth_khz: int
    max_eirp_dbm: float
    flags: Flag = NO_FLAGS


@dataclass(frozen=True, slots=True)
class Country:
    alpha2: str
    dfs_region: DfsRegion
    rules: tuple[FrequencyRule, ...]


@dataclass(frozen=True, slots=True)
class Regdb:
    """All countries by their ISO 3166-1 alpha-2 code; `source` is the file they come from."""

    countries: Mapping[str, Country]
    source: str

    def country(self, alpha2: str) -> Country | None:
        """The country's rules; None if the database has none."""
        return self.countries.get(alpha2)
