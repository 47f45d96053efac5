"""Capabilities of radio drivers (MC841)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key, join_limited
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Band, Fleet, HardwareProfile, MeshMode, RadioHardware

# modes that no firmware of the driver supports (docs/facts/openwrt-facts.md, section 6)
_LACKS = {
    "ath10k": frozenset({MeshMode.ADHOC}),
    "ath11k": frozenset({MeshMode.ADHOC}),
    "ath12k": frozenset({MeshMode.ADHOC}),
    "brcmfmac": frozenset({MeshMode.MESH}),
}
_MODE_NAMES = {MeshMode.ADHOC: "ad-hoc", MeshMode.MESH: "802.11s"}


@fleet_rule(
    "MC841",
    Severity.WARNING,
    "The radio's driver does not support the mesh's mode",
    why="""ath10k with Qualcomm's access point firmware, ath11k and ath12k do not support ad-hoc mode, and brcmfmac does
    not support 802.11s: the interface is never created, and the node comes up without a mesh. Community firmware for
    ath10k supports ad-hoc mode: OpenWrt's kmod-ath10k-ct with ath10k-firmware-...-ct.""",
    fix="""Use `mode: mesh` with the Qualcomm drivers, ath10k-ct instead of ath10k, or another radio. `driver` of the
    radio names its driver.""",
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
