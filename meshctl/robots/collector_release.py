"""The collector's part of a robot's release: a wheel with its modules, a configuration, a unit. Pure.

Only the key's public part, the pinned host keys of the robot's own radios, the addresses of these, and names of nodes
and robots are involved: nothing with which a stolen computer could change a radio.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import meshctl
from meshctl import __version__
from meshctl.archive import TarMember, tar_of
from meshctl.device.trust import HostKey
from meshctl.model import Fleet, Node, Robot
from meshctl.robots import collector
from meshctl.robots.scripts import shipped
from meshctl.robots.wheels import Wheel, wheel_of

COLLECTOR_UNIT_NAME = "udp-mesh-collector.service"
CONFIG_NAME = "collector.json"
LAUNCHER_NAME = "udp-mesh-collector"
STATE = "/var/lib/udp-mesh/collector"
LOAD_MBIT_S = 2.0
"""The load of `meshctl meter`, so that both give the same margins."""
MODULES = (
    "__init__.py",
    "device/__init__.py",
    "device/framing.py",
    "device/link_table.py",
    "device/observation.py",
    "device/parse/__init__.py",
    "device/parse/batctl.py",
    "device/parse/iw.py",
    "device/parse/jsontext.py",
    "device/parse/sections.py",
    "device/scripts/__init__.py",
    "device/scripts/links.sh",
    "placement/__init__.py",
    "placement/margin.py",
    "robots/__init__.py",
    "robots/collector.py",
    "robots/local_daemon.py",
    "robots/radio_report.py",
    "robots/radio_session.py",
)
"""The collector and what it imports; a test runs it with nothing else."""


@dataclass(frozen=True, slots=True)
class RadioKnowledge:
    """Facts about the radios that are not in the inventory: `pinned` gives the trusted host keys of a node, `names` the
    node of each MAC that was observed."""

    pinned: Callable[[str], tuple[HostKey, ...]] = lambda node: ()
    names: Callable[[], Mapping[str, str]] = dict


@cache
def collector_wheel() -> Wheel:
    """The collector as a wheel, with the standard library as its only requirement."""
    package = Path(meshctl.__file__).parent
    files = {f"meshctl/{path}": (package / path).read_bytes() for path in MODULES}
    metadata = "Requires-Python: >=3.11\nLicense: Apache-2.0\n"
    return wheel_of("meshctl-collector", __version__, files, metadata)


def has_collector(fleet: Fleet, robot: str) -> bool:
    computer = fleet.robots[robot].computer
    return computer is not None and computer.collector


def own_radios(fleet: Fleet, robot: Robot) -> tuple[Node, ...]:
    """The radios that the robot's collector asks."""
    nodes = (fleet.nodes.get(name) for name in robot.nodes)
    return tuple(node for node in nodes if node is not None and node.state.is_managed)


def collector_config(fleet: Fleet, robot: str) -> bytes:
    """The collector's configuration, as `collector.load` reads it."""
    radios = own_radios(fleet, fleet.robots[robot])
    macs = {radio.mac.lower(): node.name for node in fleet.nodes.values() for radio in node.radios if radio.mac}
    document = {
        "version": collector.VERSION,
        "robot": robot,
        "radios": [
            {"name": node.name, "host": _host(node), "port": _port(node), "user": node.ssh.user} for node in radios
        ],
        "robots": {name: list(other.nodes) for name, other in fleet.robots.items() if name != robot and other.nodes},
        "key": f"{STATE}/id_ed25519",
        "known_hosts": f"{STATE}/known_hosts",
        "names": f"{STATE}/names.json",
        "macs": macs,
        "load_mbit_s": LOAD_MBIT_S,
    }
    return f"{json.dumps(document, indent=1)}\n".encode()


def _host(node: Node) -> str:
    """From the robot's switch, where a router has another address than in the mesh."""
    return str((node.lan_address or node.address).ip)


def _port(node: Node) -> int:
    """Dropbear's own port, as in its rendered configuration."""
    return 22 if node.ssh.host else node.ssh.port


def collector_unit() -> str:
    """The stock unit."""
    return shipped(COLLECTOR_UNIT_NAME)


def collector_launcher() -> str:
    return shipped("collector-launcher.sh")


def missing_pins(fleet: Fleet, robot: str, known: RadioKnowledge) -> tuple[str, ...]:
    """The robot's radios of which no host key is pinned."""
    return tuple(node.name for node in own_radios(fleet, fleet.robots[robot]) if not known.pinned(node.name))


def radio_archive(fleet: Fleet, robot: str, known: RadioKnowledge) -> bytes:
    """A tar of what `scripts/collector.sh` places beside the key: pinned host keys, and names by MAC."""
    radios = own_radios(fleet, fleet.robots[robot])
    pins = "".join(f"{node.name} {key.text}\n" for node in radios for key in known.pinned(node.name))
    names = json.dumps(dict(sorted(known.names().items())), indent=0)
    return tar_of([TarMember("known_hosts", pins.encode()), TarMember("names.json", names.encode())])
