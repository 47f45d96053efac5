"""Each OpenWrt release as seen from a shell: versions, package manager, packages of its image.

Version and revision strings are those of the release builds on downloads.openwrt.org; batman-adv's are from
docs/facts/openwrt-facts.md section 10. Packages of a virtual image have the release's version: nothing depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass

from meshctl.model import PackageTool, Release


@dataclass(frozen=True, slots=True)
class ReleaseFacts:
    version: str
    revision: str
    kernel: str
    batman: str
    firewall: str


_FACTS = {
    Release.V19_07: ReleaseFacts("19.07.10", "r11427-9ce6aa9d8d", "4.14.275", "2019.2", "firewall"),
    Release.V21_02: ReleaseFacts("21.02.7", "r16847-f8282da11e", "5.4.238", "2021.1-openwrt-9", "firewall"),
    Release.V22_03: ReleaseFacts("22.03.5", "r20134-5f15225c1e", "5.10.176", "2022.0-openwrt-3", "firewall4"),
    Release.V23_05: ReleaseFacts("23.05.5", "r24106-10cc5fcd00", "5.15.167", "2023.1-openwrt-3", "firewall4"),
    Release.V24_10: ReleaseFacts("24.10.5", "r29087-d9c5716d1d", "6.6.119", "2024.3-openwrt-3", "firewall4"),
    Release.V25_12: ReleaseFacts("25.12.0", "r32713-f919e7899d", "6.12.71", "2025.4-openwrt-5", "firewall4"),
}
ARCH = "mips_24kc"
_COMMON = (
    "base-files",
    "busybox",
    "dnsmasq",
    "dropbear",
    "hostapd-common",
    "iw",
    "iwinfo",
    "kernel",
    "kmod-ath9k",
    "libc",
    "logd",
    "mtd",
    "netifd",
    "odhcpd-ipv6only",
    "procd",
    "ubus",
    "ubusd",
    "uci",
    "uclient-fetch",
)


def facts(release: Release) -> ReleaseFacts:
    return _FACTS[release]


def image_packages(release: Release, extra: tuple[str, ...]) -> tuple[str, ...]:
    """The packages of an image: the release's own and `extra`; a `wpad-*` among these replaces wpad-basic."""
    known = _FACTS[release]
    tool = ("apk-mbedtls",) if release.package_tool is PackageTool.APK else ("opkg",)
    scripts = ("wifi-scripts",) if release >= Release.V24_10 else ()
    own = (*_COMMON, *scripts, known.firewall)
    supplicant = () if any(name.startswith("wpad") for name in extra) else ("wpad-basic-mbedtls",)
    return tuple(sorted({*own, *tool, *supplicant, *extra}))


def firmware_text(release: Release, packages: tuple[str, ...], target: str) -> str:
    """An image's content as shell lines `NAME='value'` for the node's stand-ins; without STATE."""
    known = _FACTS[release]
    tool = release.package_tool
    lines = {
        "SERIES": release.value,
        "VERSION": known.version,
        "REVISION": known.revision,
        "KERNEL": known.kernel,
        "BATMAN": known.batman,
        "BUILD_DATE": "1765996800",
        "TARGET": target,
        "ARCH": ARCH,
        "PACKAGE_TOOL": tool.value,
        "PACKAGE_DB": "/lib/apk/db/installed" if tool is PackageTool.APK else "/usr/lib/opkg/status",
        "PACKAGES": " ".join(f"{name}={known.version}-r1" for name in image_packages(release, packages)),
    }
    return "".join(f"{name}='{value}'\n" for name, value in lines.items())
