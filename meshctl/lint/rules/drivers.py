"""Radio drivers and device paths (MC841 to MC844)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.openwrt_names import chip_driver, one_edit_apart, similar_radio_paths
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Band, Fleet, HardwareProfile, MeshMode, Node, RadioHardware, Release
from meshctl.suggest import suggestion
from meshctl.wording import join_limited

# modes that no firmware of the driver supports (docs/facts/openwrt-facts.md, section 6)
_LACKS = {
    "ath10k": frozenset({MeshMode.ADHOC}),
    "ath11k": frozenset({MeshMode.ADHOC}),
    "ath12k": frozenset({MeshMode.ADHOC}),
    "brcmfmac": frozenset({MeshMode.MESH}),
}
# kernel modules of radios in OpenWrt 19.07 to 25.12 (package/kernel/mac80211, mt76, ath10k-ct, mwlwifi)
_DRIVERS = frozenset(
    [
        *("ath5k", "ath9k", "ath9k-htc", "ath10k", "ath10k-ct", "ath11k", "ath12k", "ar5523", "b43", "brcmfmac"),
        *("brcmsmac", "carl9170", "iwlwifi", "mac80211-hwsim", "mt7601u", "mt7603", "mt7615e", "mt7663u", "mt76x0e"),
        *("mt76x0u", "mt76x2", "mt76x2u", "mt7915e", "mt7921e", "mt7921u", "mt7925e", "mt7996e", "mwifiex-pcie"),
        *("mwlwifi", "rt2800-pci", "rt2800-soc", "rt2800-usb", "rtl8192cu", "rtl8821ae", "rtl8xxxu", "rtw88", "rtw89"),
        "wil6210",
    ]
)
# PCI buses and slots in the kernel's device paths: domain:bus, domain:bus:device.function, and `+1` for a second radio
_PCI_BUS = re.compile(r"pci[0-9a-f]{4}:[0-9a-f]{2}")
_PCI_SLOT = re.compile(r"[0-9a-f]{4}:[0-9a-f]{2}:[0-9a-f]{2}\.[0-7](\+\d+)?")
_LIKE_PCI_BUS = re.compile(r"[a-z]*[0-9a-f]{4}:[0-9a-f]{2}")
_LIKE_PCI_SLOT = re.compile(r"[0-9a-z]+:[0-9a-z:]+\.[0-9+]+|[0-9a-f]+:[0-9a-f]+:[0-9a-f]+")
# `mt76` and `rtw8` begin several drivers; shorter names begin too many
_MIN_FAMILY_LETTERS = 4
_MODE_NAMES = {MeshMode.ADHOC: "ad-hoc", MeshMode.MESH: "802.11s"}


@fleet_rule(
    "MC841",
    Severity.WARNING,
    "The radio's driver does not support the mesh's mode",
    why="""ath10k with Qualcomm's access point firmware, ath11k and ath12k do not support ad-hoc mode, and brcmfmac does
    not support 802.11s: the interface is never created, and the node comes up without a mesh. Community firmware for
    ath10k supports ad-hoc mode: OpenWrt's kmod-ath10k-ct with ath10k-firmware-...-ct.""",
    fix="""Use `mode: mesh` with the Qualcomm drivers, ath10k-ct instead of ath10k, or another radio. `driver` of the
    radio names its driver; without it, only the device knows, and `meshctl plan` refuses what its radio cannot do.""",
    failing="""
    hardware: {rocket: {radios: {radio0: {driver: ath10k}}}}
    """,
    passing="""
    hardware: {rocket: {radios: {radio0: {driver: ath10k-ct}, radio1: {driver: ath10k}}}}
    """,
)
def driver_lacks_mode(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    joined = (
        ((node.hardware.name, radio.name, radio.mesh), node.name)
        for node in fleet.managed()
        for radio in node.radios
        if radio.mesh in fleet.meshes
    )
    for (profile_name, radio_name, mesh_name), nodes in group_by_key(joined).items():
        profile = fleet.hardware[profile_name]
        radio = profile.radio(radio_name)
        mode = fleet.meshes[mesh_name or ""].mode
        driver, path = ("", ()) if radio is None else _driver(profile, radio)
        if mode in _LACKS.get(driver, frozenset()):
            message = f"{radio_name} joins mesh {mesh_name} on {join_limited(nodes)}"
            yield Finding(path, message, f"a driver with {_MODE_NAMES[mode]} mode", driver)


def _driver(profile: HardwareProfile, radio: RadioHardware) -> tuple[str, tuple[str, ...]]:
    """The radio's driver and the path that names it: `driver`, or, at 5 GHz, the package of a driver for that band.

    ath9k drives the 2.4 GHz radio of boards that have both, so a package does not identify that one.
    """
    place = ("hardware", profile.name, "radios", radio.name, "driver")
    if radio.driver or radio.band is not Band.G5 or any(other.driver for other in profile.radios):
        return radio.driver, place
    for index, package in enumerate(profile.packages):
        driver = package.removeprefix("kmod-").removesuffix("-smallbuffers")
        if package.startswith("kmod-") and driver in _LACKS:
            return driver, ("hardware", profile.name, "packages", str(index))
    return "", place


@fleet_rule(
    "MC842",
    Severity.WARNING,
    "A radio's driver is misspelled",
    why="""Lint knows by the driver which modes the radio supports. With a misspelled name it checks nothing, and a mesh
    that the radio cannot join shows only in the field.""",
    fix="Use the kernel module's name as in OpenWrt: `kmod-NAME` without `kmod-`, such as ath9k or ath10k-ct.",
    failing="hardware: {rocket: {radios: {radio0: {driver: aht9k}}}}",
    passing="hardware: {rocket: {radios: {radio0: {driver: ath9k}, radio1: {driver: my-vendor-driver}}}}",
)
def driver_misspelt(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            if not radio.driver or radio.driver in _DRIVERS:
                continue
            near = _meant(radio.driver)
            if near or radio.driver.isdigit():
                path = ("hardware", profile.name, "radios", radio.name, "driver")
                expected = join_limited(near) or "a driver such as ath9k"
                yield Finding(path, "unknown driver", expected, radio.driver, suggestion(near[:3]))


def _meant(driver: str) -> tuple[str, ...]:
    """The known drivers that a name probably means: a package's, one with a typo, or that of a family (`mt76`)."""
    bare = driver.removeprefix("kmod-")
    if bare in _DRIVERS:
        return (bare,)
    return one_edit_apart(bare, _DRIVERS) or tuple(
        sorted(known for known in _DRIVERS if len(bare) >= _MIN_FAMILY_LETTERS and known.startswith(bare))
    )


@fleet_rule(
    "MC843",
    Severity.WARNING,
    "A radio's path is not a device path",
    why="""The node's wifi scripts find the radio by its path in the kernel. With another path they find none: the
    section is ignored, and the node comes up without a mesh.""",
    fix="Copy the path from the device: `uci get wireless.radio0.path`.",
    failing="hardware: {rocket: {radios: {radio0: {path: 'pci000:00/0000:00:00.0'}}}}",
    passing="hardware: {rocket: {radios: {radio0: {path: 'pci0000:00/0000:00:01.0/0000:02:00.0'}}}}",
)
def path_of_no_device(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for profile in fleet.hardware.values():
        for radio in profile.radios:
            near = similar_radio_paths(radio.path)
            if not radio.path or (_is_device_path(radio.path) and not near):
                continue
            path = ("hardware", profile.name, "radios", radio.name, "path")
            expected = " or ".join(near) or "a path such as platform/ahb/18100000.wmac or pci0000:00/0000:00:00.0"
            yield Finding(path, "not a path in the kernel's device tree", expected, radio.path, suggestion(near))


def _is_device_path(path: str) -> bool:
    """Whether it names a device below a bus, and its PCI buses and slots have the kernel's form."""
    parts = path.split("/")
    is_plausible = len(parts) > 1 and all(parts) and not re.search(r"\s", path)
    # the device is behind its bus
    return is_plausible and not _PCI_BUS.fullmatch(parts[-1]) and not any(_is_bad_pci(part) for part in parts)


def _is_bad_pci(part: str) -> bool:
    if part.startswith("pci") or _LIKE_PCI_BUS.fullmatch(part):
        return _PCI_BUS.fullmatch(part) is None
    return _LIKE_PCI_SLOT.fullmatch(part) is not None and _PCI_SLOT.fullmatch(part) is None


# drivers of radios up to 802.11n and 802.11ac, and those of Wi-Fi 6; others may do 802.11be
_HT_ONLY = frozenset(
    [
        *("ath9k", "ath9k-htc", "carl9170", "brcmsmac", "mt7601u", "mt7603", "rt2800-pci", "rt2800-soc"),
        *("rt2800-usb", "rtl8192cu"),
    ]
)
_UP_TO_VHT = frozenset(
    [
        *("ath10k", "ath10k-ct", "brcmfmac", "mt7615e", "mt7663u", "mt76x0e", "mt76x0u", "mt76x2", "mt76x2u"),
        *("mwifiex-pcie", "mwlwifi", "rtl8821ae", "rtw88"),
    ]
)
_UP_TO_HE = frozenset({"ath11k", "mt7915e", "mt7921e", "mt7921u"})
_BEST = {**dict.fromkeys(_HT_ONLY, "HT"), **dict.fromkeys(_UP_TO_VHT, "VHT"), **dict.fromkeys(_UP_TO_HE, "HE")}
_GENERATIONS = ("HT", "VHT", "HE", "EHT")
# the first release whose scripts know the htmodes (mac80211.sh, wifi-scripts)
_SINCE = {"HE": Release.V21_02, "EHT": Release.V24_10}


@fleet_rule(
    "MC844",
    Severity.WARNING,
    "A radio or release does not support the mesh's htmode",
    why="""ath9k and other radios of 802.11n know no VHT, 802.11ac no HE, and 19.07's scripts no HE at all. Depending on
    the release the interface is not created, or joins the mesh with 802.11g rates and another width than its
    neighbors.""",
    fix="""Use HT20 or HT40 with 802.11n, VHT with 802.11ac, HE with Wi-Fi 6 from 21.02 on and EHT from 24.10 on;
    correct `driver` of the radio if it is another one.""",
    failing="""
    hardware: {rocket: {radios: {radio0: {driver: ath9k}}}}
    meshes: {main: {htmode: HE20}}
    """,
    passing="""
    hardware: {rocket: {radios: {radio0: {driver: mt7915e}}}}
    meshes: {main: {htmode: HE20}}
    """,
)
def htmode_beyond_radio(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    joined = (
        ((mesh.name, limit), node.name)
        for node in fleet.managed()
        for radio in node.radios
        if (mesh := fleet.meshes.get(radio.mesh or "")) is not None
        for limit in htmode_limits(node, radio.hardware, mesh.htmode)
    )
    for (name, limit), nodes in group_by_key(joined).items():
        mesh = fleet.meshes[name]
        message = f"{limit} has no {generation(mesh.htmode)}: {join_limited(nodes)}"
        yield Finding(("meshes", mesh.name, "htmode"), message, "an htmode that all its radios support", mesh.htmode)


def generation(htmode: str) -> str:
    return htmode.rstrip("0123456789+-")


def htmode_limits(node: Node, radio: RadioHardware, htmode: str) -> Iterator[str]:
    """The reason why the node's radio cannot use the htmode: its driver, its release."""
    wanted = generation(htmode)
    if wanted not in _GENERATIONS:
        return
    named, _ = _driver(node.hardware, radio)
    driver = named if named in _BEST else chip_driver(radio.path)
    best = _BEST.get(driver, "EHT")
    if _GENERATIONS.index(wanted) > _GENERATIONS.index(best):
        yield f"{driver} ({radio.name} of {node.hardware.name})"
    if wanted in _SINCE and node.release < _SINCE[wanted]:
        yield f"OpenWrt {node.release}"
