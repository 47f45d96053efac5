"""Checks the abilities of a radio's chip and driver, as the device reports them, against the inventory. Pure.

The inventory does not know which chip sits in a PCI slot, and ath10k differs from ath10k-ct by its firmware alone, so
the kernel's own list decides (`iw phy`).
"""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.device.observation import Observation, RadioChip
from meshctl.model import Band, Node
from meshctl.plan.cell import enabled_interfaces
from meshctl.regdb.channels import CHANNELS, center_mhz
from meshctl.uci import Package, Section

# UCI's modes as iw names them, and as messages do
IW_MODES = {"adhoc": "IBSS", "mesh": "mesh point", "ap": "AP", "sta": "managed"}
_NAMES = {"adhoc": "ad-hoc mode", "mesh": "802.11s", "ap": "access point mode", "sta": "station mode"}


def lacking_abilities(
    node: Node, observation: Observation, before: Package | None, desired: Package | None
) -> tuple[str, ...]:
    """Requirements of the desired wireless configuration that the node's radios cannot meet: one text each.

    A radio that the device does not describe is left out; `before` is its present configuration.
    """
    paths = {section.name: section.get("path") for section in (before.of_type("wifi-device") if before else ())}
    found: dict[str, None] = {}
    for iface, device in enabled_interfaces(desired):
        hardware = node.hardware.radio(device.name or "")
        path = (hardware.path if hardware is not None else "") or paths.get(device.name, "")
        chip = next((known_chip for known_chip in observation.chips or () if path and known_chip.path == path), None)
        if hardware is not None and chip is not None:
            found.update(dict.fromkeys(_lacking(chip, hardware.band, iface, device)))
    return tuple(found)


def _lacking(chip: RadioChip, band: Band, iface: Section, device: Section) -> Iterator[str]:
    name = f"{device.name}{f' ({chip.driver})' if chip.driver else ''}"
    mode, channel = iface.get("mode"), device.get("channel")
    if chip.modes and mode in IW_MODES and IW_MODES[mode] not in chip.modes:
        yield f"{name} has no {_NAMES[mode]}: its driver supports {', '.join(chip.modes)}"
    known = chip.frequencies_mhz
    if not known or not channel.isdigit() or int(channel) not in CHANNELS[band]:
        return
    if not any(_band_of(mhz) is band for mhz in known):
        yield f"{name} does not work at {_GHZ[band]} GHz: it has {known[0]} to {known[-1]} MHz"
    elif center_mhz(band, int(channel)) not in known:
        yield f"{name} has no channel {channel}"


_GHZ = {Band.G2: "2.4", Band.G5: "5"}


def _band_of(mhz: int) -> Band | None:
    return Band.G2 if mhz < 3000 else Band.G5 if mhz < 5935 else None
