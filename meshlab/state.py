"""The supervisor's state of one node, and the files that describe its board and flash chip to the node."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

from meshctl.model import Release
from meshlab.mesh_model import EffectiveState
from meshlab.releases import firmware_text
from meshlab.spec import NodeSpec


class Power(Enum):
    """The power state of a node."""

    OFF = "off"
    BOOTING = "booting"
    UP = "up"
    FLASHING = "flashing"
    # its firmware does not start: the image was written in part
    DEAD = "dead"
    # this machine could not start it, for `NodeState.reason`
    FAILED = "failed"


@dataclass(slots=True)
class NodeState:
    """`want_on`: the power switch. `boots` counts boots, so that a connection can detect a restart of its node."""

    spec: NodeSpec
    number: int
    home: Path
    plugged: bool
    power: Power = Power.OFF
    want_on: bool = True
    pid: int = 0
    boots: int = 0
    boot_id: str = ""
    reason: str = ""
    effective: EffectiveState = field(default_factory=EffectiveState)
    hung: bool = False
    cut_at_flash: bool = False
    wrong_board: bool = False
    faults: list[str] = field(default_factory=list)

    @property
    def is_running(self) -> bool:
        return self.power in (Power.BOOTING, Power.UP, Power.FLASHING)


def write_board(state: NodeState, radios_mac: str, seed: int = 0) -> None:
    """Write the files that describe the node's board to its stand-ins, which source them. Replaced atomically.

    `seed` seeds the random start-up times of its services.
    """
    spec = state.spec
    types = spec.host_key_types
    if types is None:
        types = ("rsa", "ed25519") if spec.release.has_ed25519 else ("rsa",)
    radios = []
    for place, radio in enumerate(spec.radios):
        mac = radio.mac or _next_mac(radios_mac, place + 1)
        radios.append(f"{radio.name},{radio.path},{radio.band},{mac},{radio.max_tx_power_dbm},{radio.driver}")
    facts = {
        "BOARD_NAME": "virtual,other-board" if state.wrong_board else spec.board,
        "MODEL": spec.model,
        "LAN_PORTS": " ".join(spec.lan_ports),
        # a VLAN (eth0.1) is on a port of the board
        "PORTS": " ".join(dict.fromkeys(name for port in spec.lan_ports for name in (port.partition(".")[0], port))),
        "LAN_MAC": radios_mac,
        "RADIOS": " ".join(radios),
        "HOST_KEY_TYPES": " ".join(types),
        "FLASH_S": f"{spec.flash_s:g}",
        "FIRST_BOOT_S": f"{spec.first_boot_s:g}",
        "SLOWNESS": str(spec.slowness),
        "SEED": str(seed * 1000 + state.number),
    }
    _replace(state.home / "board", "".join(f"{key}={shlex.quote(value)}\n" for key, value in facts.items()))
    _replace(state.home / "name", f"{spec.name} {state.number}\n")


def write_firmware(home: Path, release: Release, packages: tuple[str, ...], target: str) -> None:
    """Write a complete image of a release into the node's flash chip."""
    (home / "firmware").mkdir(parents=True, exist_ok=True)
    _replace(home / "firmware" / "env", firmware_text(release, packages, target) + "STATE=whole\n")


def label_mac(spec: NodeSpec, number: int) -> str:
    """The MAC address on the label: the specified one, or a locally administered one with the node's number."""
    return spec.mac or f"02:4d:{number // 256:02x}:{number % 256:02x}:00:00"


def _next_mac(mac: str, step: int) -> str:
    value = int(mac.replace(":", ""), 16) + step
    return ":".join(f"{value:012x}"[place : place + 2] for place in range(0, 12, 2))


def _replace(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_name(path.name + ".new")
    new.write_text(text, encoding="utf-8")
    new.replace(path)
