"""A device's board -> an entry of `hardware`, or the profile of the inventory that fits it best. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from meshctl.errors import InputError
from meshctl.interchange.device import ExistingDevice
from meshctl.interchange.interfaces import wired_ports
from meshctl.interchange.wireless import ExistingRadio
from meshctl.inventory.yaml_text import Value
from meshctl.model import Fleet, HardwareProfile
from meshctl.uci import Package, Section

# Where neither the configuration nor the radio says it.
ASSUMED_POWER_DBM = 20


def known_profile(
    device: ExistingDevice, fleet: Fleet | None, named: str, radios: tuple[ExistingRadio, ...]
) -> HardwareProfile | None:
    """The inventory's profile `named`, or else the one of the device's board; None without one.

    Raises InputError if there is no profile of that name.
    """
    known: Mapping[str, HardwareProfile] = {} if fleet is None else fleet.hardware
    if named:
        if named not in known:
            raise InputError(f"--hardware {named}: no such profile, found {', '.join(known) or 'none'}")
        return known[named]
    found = [profile for profile in known.values() if profile.board == device.board]
    return min(found, key=lambda profile: _distance(profile, device, radios), default=None)


def profile_name(device: ExistingDevice) -> str:
    """The ImageBuilder's name of the board, as it usually is."""
    return device.board.replace(",", "_")


def _distance(profile: HardwareProfile, device: ExistingDevice, radios: Iterable[ExistingRadio]) -> int:
    """In how much a profile of the same board differs from the device."""
    paths = {(radio.name, radio.path) for radio in radios} ^ {(radio.name, radio.path) for radio in profile.radios}
    return len(paths) + 2 * (profile.release is not device.release)


def hardware_entry(
    device: ExistingDevice, radios: tuple[ExistingRadio, ...], lan: Section
) -> tuple[dict[str, Value], list[str]]:
    """A new profile for the device, and what had to be assumed."""
    name = profile_name(device)
    assumed = [f"profile: {name}, from the board's name"]
    found: dict[str, Value] = {
        "board": device.board,
        "profile": name,
        "target": device.target,
        "release": device.release.value,
        "lan_ports": list(wired_ports(device, radios, lan)),
    }
    if device.memory_mib is not None:
        found["memory_mib"] = device.memory_mib
    vlans = _switch_vlans(device.package("network"))
    if vlans:
        found["switch_vlans"] = dict(vlans)
    found["radios"] = {radio.name: _radio_hardware(device, radio, assumed) for radio in radios}
    return found, assumed


def _radio_hardware(device: ExistingDevice, radio: ExistingRadio, assumed: list[str]) -> dict[str, Value]:
    link = None if radio.interface is None else device.link(radio.interface)
    measured = None if link is None or link.tx_power_dbm is None else round(link.tx_power_dbm)
    power = radio.tx_power_dbm if radio.tx_power_dbm is not None else measured
    source = "the radio's current power" if power is not None else "a common one"
    drive = ASSUMED_POWER_DBM if power is None else power
    assumed.append(
        f"radios.{radio.name}: rated_power_dbm and max_drive_dbm {drive}, {source}; antenna gain 0 dBi: "
        "take them from the data sheet"
    )
    return {
        "path": radio.path,
        "band": radio.band.value,
        "rated_power_dbm": drive,
        "max_drive_dbm": drive,
    }


def _switch_vlans(network: Package) -> tuple[tuple[str, str], ...]:
    """The VLANs of switch0, if the device's sections are exactly those that the inventory renders to."""
    switches = [dict(section.options) for section in network.of_type("switch")]
    if switches != [{"name": "switch0", "reset": "1", "enable_vlan": "1"}]:
        return ()
    members = [dict(section.options) for section in network.of_type("switch_vlan")]
    for member in members:
        # LuCI writes the VLAN's ID also where it is its number
        if member.get("vid") == member.get("vlan"):
            member.pop("vid", None)
    if any(set(member) != {"device", "vlan", "ports"} or member["device"] != "switch0" for member in members):
        return ()
    return tuple((str(member["vlan"]), str(member["ports"])) for member in members)
