"""A device's wireless and batman-adv sections in the inventory's terms. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from meshctl.interchange.device import ExistingDevice
from meshctl.model import Band, Encryption, MeshMode
from meshctl.uci import Package, Section

MESH_MODES: Mapping[str, MeshMode] = {"adhoc": MeshMode.ADHOC, "mesh": MeshMode.MESH}
_HWMODES: Mapping[str, Band] = {
    "11b": Band.G2, "11g": Band.G2, "11ng": Band.G2, "11bg": Band.G2, "11a": Band.G5, "11na": Band.G5, "11ac": Band.G5,
}  # fmt: skip
LAST_2G_CHANNEL = 14
# without `option encryption`, the interface is open
_ENCRYPTIONS = (("sae", Encryption.SAE), ("psk", Encryption.PSK2))


@dataclass(frozen=True, slots=True)
class ExistingRadio:
    """A wifi-device section and its mesh interface, None if it has none that is enabled. `hardif` and `batman` are the
    sections in `network` that connect the interface with batman-adv."""

    section: Section
    name: str
    path: str
    band: Band
    interface: Section | None = None
    hardif: Section | None = None
    batman: Section | None = None

    @property
    def tx_power_dbm(self) -> int | None:
        return integer(self.section.get("txpower"))


def existing_radios(device: ExistingDevice) -> Iterator[ExistingRadio]:
    """The radios of 2.4 and 5 GHz with a path, in the device's order."""
    wireless, network = device.package("wireless"), device.package("network")
    for section in wireless.of_type("wifi-device"):
        band = _band(section)
        if section.name is None or not section.get("path") or band is None:
            continue
        interface = None if section.get("disabled") == "1" else _mesh_interface(wireless, section.name)
        hardif = None if interface is None else _hardif(network, interface)
        master = "" if hardif is None else hardif.get("master") or hardif.get("mesh")
        yield ExistingRadio(
            section, section.name, section.get("path"), band, interface, hardif, network.section(master)
        )


def unsupported_radios(device: ExistingDevice) -> Iterator[str]:
    """Names of wifi-device sections without a path or of another band."""
    known = {radio.name for radio in existing_radios(device)}
    sections = device.package("wireless").of_type("wifi-device")
    return (section.name or "(anonymous)" for section in sections if section.name not in known)


def _band(section: Section) -> Band | None:
    written = section.get("band")
    if written:
        return next((band for band in Band if band.value == written), None)
    if section.get("hwmode") in _HWMODES:
        return _HWMODES[section.get("hwmode")]
    channel = integer(section.get("channel"))
    return None if channel is None else Band.G2 if channel <= LAST_2G_CHANNEL else Band.G5


def _mesh_interface(wireless: Package, radio: str) -> Section | None:
    return next(
        (
            section
            for section in wireless.of_type("wifi-iface")
            if section.get("device") == radio and section.get("mode") in MESH_MODES and section.get("disabled") != "1"
        ),
        None,
    )


def _hardif(network: Package, interface: Section) -> Section | None:
    """The interface with batman-adv's hard interface (kmod-batman-adv before 19.07 called the protocol `batadv`)."""
    names = (network.section(name) for name in interface.get("network").split())
    return next(
        (
            section
            for section in names
            if section is not None
            and (section.get("proto") == "batadv_hardif" or (section.get("proto") == "batadv" and section.get("mesh")))
        ),
        None,
    )


def is_meshmerize(device: ExistingDevice, radio: ExistingRadio) -> bool:
    """Whether meshmerize routes the radio's mesh: by its package's file, or by the interface that meshctl renders."""
    if radio.interface is None or radio.hardif is not None:
        return False
    names = radio.interface.get("network").split()
    sections = filter(None, map(device.package("network").section, names))
    return "meshmerize" in device.packages or any(section.get("proto") == "none" for section in sections)


def mesh_id(interface: Section) -> str:
    """The SSID of an IBSS or the mesh ID of 802.11s."""
    return interface.get("ssid") if interface.get("mode") == "adhoc" else interface.get("mesh_id")


def encryption(interface: Section) -> Encryption:
    """The nearest encryption that the inventory has."""
    written = interface.get("encryption")
    return next((kind for prefix, kind in _ENCRYPTIONS if written.startswith(prefix)), Encryption.NONE)


def integer(text: str) -> int | None:
    return int(text) if text.isascii() and text.isdecimal() else None
