"""Known names of OpenWrt targets, packages and built-in radio paths.

The lists are incomplete, so an unlisted name is not an error; a name one edit away from a listed one is.
Sources: target/linux and package/ of OpenWrt 19.07 to 25.12.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from types import MappingProxyType

from meshctl.resolve import FULL_SUPPLICANTS


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


TARGETS = _words(
    """airoha apm821xx ar71xx archs38 armsr armvirt at91 ath25 ath79 bcm27xx bcm47xx bcm4908 bcm53xx bcm63xx bmips
    brcm2708 brcm47xx brcm63xx cns3xxx d1 econet gemini imx imx6 ipq40xx ipq806x ipq807x ixp4xx kirkwood lantiq
    layerscape loongarch64 malta mediatek microchipsw mpc85xx mvebu mxs nxp octeon octeontx omap oxnas pistachio qoriq
    qualcommax qualcommbe ramips rb532 realtek rockchip sifiveu siflower starfive stm32 sunxi tegra uml x86 zynq"""
)
# targets that 21.02 no longer has, and what took their place
SUCCESSORS: Mapping[str, str] = MappingProxyType({"ar71xx": "ath79", "brcm2708": "bcm27xx", "brcm47xx": "bcm47xx"})
SUBTARGETS: Mapping[str, frozenset[str]] = MappingProxyType(
    {
        "ath79": _words("generic mikrotik nand tiny"),
        "ramips": _words("mt7620 mt7621 mt76x8 rt288x rt305x rt3883"),
        "mediatek": _words("filogic mt7622 mt7623 mt7629"),
        "ipq40xx": _words("chromium generic mikrotik"),
        "ipq806x": _words("chromium generic"),
        "x86": _words("64 generic geode legacy"),
    }
)
# device tree paths of radios that exist only on boards of this target, and their driver where its limits are known
_CHIPS = (
    (re.compile(r"platform/ahb/.*\.wmac"), "ath79", "ath9k"),
    (re.compile(r"platform/(ar9\w+|qca9\w+)_wmac"), "ar71xx", "ath9k"),
    (re.compile(r"platform/10180000\.wmac"), "ramips", "rt2800-soc"),
    (re.compile(r"platform/10300000\.wmac"), "ramips", "mt7603"),
    (re.compile(r"platform/(soc/)?18000000\.(wmac|wifi)"), "mediatek", ""),
    (re.compile(r"platform/soc/a[08]00000\.wifi"), "ipq40xx", "ath10k-ct"),
    (re.compile(r"platform/soc@0/c000000\.wifi"), "qualcommax", ""),
    # behind the chip's own PCI controller; the driver is that of the card
    (re.compile(r"(platform/)?1e140000\.pcie/pci.*"), "ramips", ""),
    (re.compile(r"(platform/)?(1a14[35]000|11280000)\.pcie/pci.*"), "mediatek", ""),
    (re.compile(r"(platform/)?soc/40000000\.pcie?/pci.*"), "ipq40xx", ""),
    (re.compile(r"(platform/)?soc/1b[579]00000\.pcie?/pci.*"), "ipq806x", ""),
)
_RADIO_PATHS = _words(
    """platform/ahb/18100000.wmac platform/ar933x_wmac platform/ar934x_wmac platform/qca953x_wmac platform/qca955x_wmac
    platform/qca956x_wmac platform/10180000.wmac platform/10300000.wmac platform/18000000.wmac platform/18000000.wifi
    platform/soc/18000000.wifi platform/soc/a000000.wifi platform/soc/a800000.wifi platform/soc@0/c000000.wifi"""
)
PACKAGES = frozenset(FULL_SUPPLICANTS) | _words(
    """wpad-basic wpad-basic-mbedtls wpad-basic-openssl wpad-basic-wolfssl wpad-mini wpa-supplicant hostapd
    hostapd-common wifi-scripts batctl-default batctl-full batctl-tiny kmod-batman-adv iw iw-full iwinfo kmod-ath5k
    kmod-ath6kl kmod-ath9k kmod-ath9k-htc kmod-ath10k kmod-ath10k-ct kmod-ath10k-ct-smallbuffers kmod-ath11k kmod-mt76
    kmod-mt7603 kmod-mt7615e kmod-mt7915e kmod-mac80211 kmod-cfg80211 ethtool tcpdump tcpdump-mini ip-full ip-tiny
    ip-bridge iperf3 iperf fping mtr-json dnsmasq dropbear firewall firewall4 odhcpd-ipv6only odhcp6c ppp-mod-pppoe
    luci luci-ssl luci-app-statistics luci-app-firewall luci-app-banip uhttpd kmod-nft-bridge kmod-nft-core kmod-nft-nat
    nftables nftables-json nftables-nojson iptables-nft zoneinfo-core openssh-sftp-server rsync collectd socat alfred
    batmand olsrd babeld snmpd
    lldpd"""
)
# shorter names are similar to too many others
_MIN_LETTERS = 6


def chip_target(radio_path: str) -> str | None:
    """The only target with a radio at this path; None if several may: USB, PCI without the chip's controller."""
    return next((target for pattern, target, _ in _CHIPS if pattern.fullmatch(radio_path)), None)


def chip_driver(radio_path: str) -> str:
    """The driver of a built-in radio at this path; empty if it is unknown (PCI, USB)."""
    return next((driver for pattern, _, driver in _CHIPS if pattern.fullmatch(radio_path)), "")


def similar_radio_paths(path: str) -> tuple[str, ...]:
    """The known paths of built-in radios that are one edit from this one; none if it is known."""
    return () if path in _RADIO_PATHS else one_edit_apart(path, _RADIO_PATHS)


def suggest_packages(name: str) -> tuple[str, ...]:
    """The known packages one edit, upper case or underscores away from `name`; none if `name` is known."""
    if name.lower() in PACKAGES:
        return () if name in PACKAGES else (name.lower(),)
    hyphened = name.replace("_", "-")
    # few names have an underscore, and no kernel module's
    if name.startswith("kmod_") or ("_" in name and hyphened in PACKAGES):
        return (hyphened,)
    if len(name) < _MIN_LETTERS:
        return ()
    # a kernel module's name as in the kernel
    if f"kmod-{hyphened}" in PACKAGES:
        return (f"kmod-{hyphened}",)
    # a kernel module whose name was cut, such as kmod-batman
    longer = [known for known in PACKAGES if name.startswith("kmod-") and known.startswith(f"{name}-")]
    if len(longer) == 1:
        return tuple(longer)
    return one_edit_apart(name, (known for known in PACKAGES if len(known) >= _MIN_LETTERS))


def one_edit_apart(name: str, known: Iterable[str]) -> tuple[str, ...]:
    """The known names that are one edit away, sorted."""
    return tuple(sorted(candidate for candidate in known if is_one_edit_apart(name, candidate)))


def is_one_edit_apart(name: str, other: str) -> bool:
    """Whether one letter is missing, added, wrong, or swapped with the next."""
    if abs(len(name) - len(other)) > 1 or name == other:
        return False
    start = next((i for i, (a, b) in enumerate(zip(name, other, strict=False)) if a != b), min(len(name), len(other)))
    rest, other_rest = name[start:], other[start:]
    swapped = rest[1:2] + rest[:1] + rest[2:]
    return other_rest in (rest[1:], swapped) or rest == other_rest[1:] or rest[1:] == other_rest[1:]
