"""OpenWrt releases in order, with the differences that matter to meshctl (docs/facts/openwrt-facts.md)."""

from __future__ import annotations

from enum import Enum
from functools import total_ordering


class PackageTool(Enum):
    """How a release installs packages: opkg up to 24.10, apk from 25.12."""

    OPKG = "opkg"
    APK = "apk"


@total_ordering
class Release(Enum):
    """A release series, ordered by age: `release >= Release.V21_02`."""

    V19_07 = "19.07"
    V21_02 = "21.02"
    V22_03 = "22.03"
    V23_05 = "23.05"
    V24_10 = "24.10"
    V25_12 = "25.12"

    def __lt__(self, other: object) -> bool:
        if not isinstance(other, Release):
            return NotImplemented
        return self.value < other.value

    def __str__(self) -> str:
        return self.value

    @property
    def package_tool(self) -> PackageTool:
        return PackageTool.APK if self >= Release.V25_12 else PackageTool.OPKG

    @property
    def has_device_sections(self) -> bool:
        """Bridges are `config device` sections and interfaces name a `device` (netifd of 21.02 and later)."""
        return self >= Release.V21_02

    @property
    def has_band_option(self) -> bool:
        """Radios carry `band '2g'` instead of `hwmode '11g'` (21.02 and later)."""
        return self >= Release.V21_02

    @property
    def has_fw4(self) -> bool:
        """The firewall is firewall4, with nftables (22.03 and later)."""
        return self >= Release.V22_03

    @property
    def has_ed25519(self) -> bool:
        """dropbear supports ed25519 keys (21.02 and later); 19.07 supports RSA with SHA-1 only."""
        return self >= Release.V21_02


RELEASES: tuple[Release, ...] = tuple(Release)
