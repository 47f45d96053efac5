"""Hardware profiles: board, radios, ports, power, firmware."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from meshctl.model.release import Release


class Band(Enum):
    """A frequency band by its UCI name."""

    G2 = "2g"
    G5 = "5g"


class AntennaKind(Enum):
    OMNI = "omni"
    SECTOR = "sector"
    PANEL = "panel"
    DISH = "dish"


@dataclass(frozen=True, slots=True)
class RadioHardware:
    """One radio of a board: `name` is the UCI section (`radio0`), `path` the kernel's device path.

    Powers are separate values because the kernel does not account for an external amplifier: UCI's txpower is the
    drive level, `max_drive_dbm` the driver's maximum, `amplifier_gain_db` the gain of the amplifier, `rated_power_dbm`
    the rated power (30 for 1 W, 33 for 2 W), and `antenna_gain_dbi` minus `cable_loss_db` the gain behind the
    connector. `driver` is the kernel module by its name in OpenWrt (`ath9k`, `ath10k-ct`), empty if not set.
    """

    name: str
    path: str
    band: Band
    rated_power_dbm: float
    max_drive_dbm: int
    amplifier_gain_db: float = 0.0
    antenna_gain_dbi: float = 0.0
    cable_loss_db: float = 0.0
    antenna: AntennaKind = AntennaKind.OMNI
    beamwidth_deg: int = 360
    chains: int = 2
    driver: str = ""


@dataclass(frozen=True, slots=True)
class Firmware:
    """An image for a profile; `image` is a path relative to `base` (the directory of the file that names it)."""

    image: str = ""
    sha256: str = ""
    revision: str = ""
    usign_key: str = ""
    base: str = ""


@dataclass(frozen=True, slots=True)
class HardwareProfile:
    """`board` is the device's own name (`ubus call system board`: `compex,wpj344-16m`), `profile` the
    ImageBuilder's name (`compex_wpj344-16m`), `target` e.g. `ath79/generic`; `lan_ports` are bridged into the LAN;
    `switch_vlans` are the VLANs of `switch0` with their ports (`("1", "3 0t")`) if swconfig drives it."""

    name: str
    board: str
    profile: str
    target: str
    release: Release
    radios: tuple[RadioHardware, ...]
    lan_ports: tuple[str, ...]
    memory_mib: int = 64
    flash_mib: int = 8
    firmware: Firmware = Firmware()
    packages: tuple[str, ...] = ()
    package_files: tuple[str, ...] = ()
    confirm_window_s: int = 120
    flash_timeout_s: int = 900
    recovery: str = ""
    switch_vlans: tuple[tuple[str, str], ...] = ()

    def radio(self, name: str) -> RadioHardware | None:
        return next((radio for radio in self.radios if radio.name == name), None)
