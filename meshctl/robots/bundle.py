"""The release for one robot: wheels, configuration files, a manifest of hashes, and an ID derived from them. Pure.

Bundles with the same ID have the same content, so a repeated deploy does nothing. Wheels are uploaded separately and
shared between releases; a change of topics or keys is a new release of a few kilobytes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from meshctl.archive import TarMember, tar_of
from meshctl.errors import InputError
from meshctl.model import Fleet, Secret, SecretRef
from meshctl.model.computers import ROS_1, ROS_2, ROS_TOO_OLD
from meshctl.render.bridge import BRIDGE_CONFIG_NAME, bridge_config
from meshctl.render.daemon import CONFIG_NAME, KEY_NAME, RELAY_KEY_NAME, daemon_config, daemon_keys, relay_keys
from meshctl.robots.collector_release import (
    COLLECTOR_UNIT_NAME,
    LAUNCHER_NAME,
    collector_config,
    collector_launcher,
    collector_unit,
    collector_wheel,
    has_collector,
)
from meshctl.robots.collector_release import CONFIG_NAME as COLLECTOR_CONFIG_NAME
from meshctl.robots.scripts import shipped
from meshctl.robots.wheels import Wheel
from meshctl.suggest import did_you_mean

UNIT_NAME = "udp-mesh.service"
BRIDGE_UNIT_NAME = "udp-mesh-ros1.service"
HOSTS_UNIT_NAME = "udp-mesh-hosts.service"
# The units in messages.
UNIT_TITLES: Mapping[str, str] = {
    UNIT_NAME: "the service",
    BRIDGE_UNIT_NAME: "the ROS bridge",
    HOSTS_UNIT_NAME: "the service for /etc/hosts",
    COLLECTOR_UNIT_NAME: "the collector",
}
# Those that only some robots have.
OPTIONAL_UNITS = (BRIDGE_UNIT_NAME, HOSTS_UNIT_NAME, COLLECTOR_UNIT_NAME)
_CURRENT = "/opt/udp-mesh/current"
# 64 bits of the SHA-256: short enough to read, long enough against accidental collisions.
_ID_DIGITS = 16
_SECRET_MODE = 0o600


@dataclass(frozen=True, slots=True)
class File:
    """A file of a release, by its path in it."""

    path: str
    content: bytes = field(repr=False)
    mode: int = 0o644

    @property
    def sha256(self) -> str:
        return hashlib.sha256(self.content).hexdigest()

    @property
    def is_secret(self) -> bool:
        return self.mode == _SECRET_MODE


@dataclass(frozen=True, slots=True)
class Bundle:
    """A release for one robot. `tree` is the ID of the unpacked wheels, for one Python, that it runs from."""

    robot: str
    tree: str
    wheels: tuple[Wheel, ...]
    files: tuple[File, ...]

    @property
    def hashes(self) -> tuple[tuple[str, str], ...]:
        """Path and hash of every file, in manifest order."""
        return tuple((file.path, file.sha256) for file in self.files)

    @property
    def manifest(self) -> bytes:
        """The manifest in the format of `sha256sum`."""
        return "".join(f"{digest}  {path}\n" for path, digest in self.hashes).encode()

    @property
    def id(self) -> str:
        modes = "".join(f"{file.mode:o} {file.path}\n" for file in self.files).encode()
        return hashlib.sha256(self.manifest + modes).hexdigest()[:_ID_DIGITS]

    @property
    def unpacked_bytes(self) -> int:
        """Disk space for all wheels, packed and unpacked."""
        return sum(wheel.unpacked_bytes + len(wheel.content) for wheel in self.wheels)

    def file(self, path: str) -> File | None:
        return next((file for file in self.files if file.path == path), None)

    def archive(self) -> bytes:
        """The release's files as a tar, with its manifest and the links to its tree."""
        directories = [TarMember(name, mode=0o755, is_directory=True) for name in ("bin", "etc", "ros1")]
        # ROS's Python finds our package in ros1/, without the wheels built for another Python
        links = [
            TarMember("lib", link_to=f"../../trees/{self.tree}"),
            TarMember("ros1/udp_mesh", link_to="../lib/udp_mesh"),
        ]
        files = (*self.files, File("manifest", self.manifest))
        return tar_of([*directories, *links, *(TarMember(file.path, file.content, file.mode) for file in files)])


def bundle(
    fleet: Fleet,
    robot: str,
    secrets: Callable[[SecretRef], Secret],
    wheels: Sequence[Wheel],
    *,
    executable: str,
    units: Mapping[str, str],
) -> Bundle:
    """The bundle for one robot; `executable` is the absolute path of its Python, `units` the shipped unit files.

    `wheels` are those of the daemon. Raises InvalidInput for settings the daemon would reject, and for missing keys.
    """
    if has_collector(fleet, robot):
        wheels = (*wheels, collector_wheel())
    listed = "".join(f"{wheel.sha256}  {wheel.stored}\n" for wheel in wheels).encode()
    tree = hashlib.sha256(listed + executable.encode()).hexdigest()[:_ID_DIGITS]
    files = [
        *configuration(fleet, robot, secrets, units),
        File("python", f"{executable}\n".encode()),
        File("tree", f"{tree}\n".encode()),
        File("wheels", listed),
    ]
    return Bundle(robot, tree, tuple(wheels), tuple(sorted(files, key=lambda file: file.path)))


def configuration(
    fleet: Fleet, robot: str, secrets: Callable[[SecretRef], Secret], units: Mapping[str, str]
) -> tuple[File, ...]:
    """The files of a release that depend only on the inventory, not on the computer's Python and wheels.

    Raises InvalidInput as `bundle` does.
    """
    topics = "".join(f"{topic.name}\n" for topic in fleet.topics).encode()
    start = f"{_CURRENT}/bin/udp-mesh run {_CURRENT}/etc/{CONFIG_NAME}"
    files = [
        File("bin/udp-mesh", shipped("launcher.sh").encode(), 0o755),
        File(f"etc/{CONFIG_NAME}", daemon_config(fleet, robot)),
        File("topics", topics),
        File(UNIT_NAME, _with_serial_ports(fleet, robot, service_unit(units[UNIT_NAME], start)).encode()),
    ]
    for name, keys in ((KEY_NAME, daemon_keys(fleet, secrets)), (RELAY_KEY_NAME, relay_keys(fleet, secrets))):
        if keys is not None:
            files.append(File(f"etc/{name}", keys, _SECRET_MODE))
    if fleet.udp_mesh.etc_hosts:
        hosts = f"{_CURRENT}/bin/udp-mesh hosts"
        unit = service_unit(units[HOSTS_UNIT_NAME], f"{hosts} --write /etc/hosts", f"{hosts} --remove /etc/hosts")
        files.append(File(HOSTS_UNIT_NAME, unit.encode()))
    if has_collector(fleet, robot):
        command = f"{_CURRENT}/bin/{LAUNCHER_NAME}"
        files += [
            File(f"bin/{LAUNCHER_NAME}", collector_launcher().encode(), 0o755),
            File(f"etc/{COLLECTOR_CONFIG_NAME}", collector_config(fleet, robot)),
            File(COLLECTOR_UNIT_NAME, service_unit(collector_unit(), command).encode()),
        ]
    if has_bridge(fleet, robot):
        reductions = bridge_config(fleet)
        files += [
            File("bin/udp-mesh-ros1", shipped("bridge.sh").encode(), 0o755),
            File("ros", f"/opt/ros/{ROS_1}/setup.bash\n".encode()),
            *([] if reductions is None else [File(f"etc/{BRIDGE_CONFIG_NAME}", reductions)]),
            File(BRIDGE_UNIT_NAME, service_unit(units[BRIDGE_UNIT_NAME], f"{_CURRENT}/bin/udp-mesh-ros1").encode()),
        ]
    return tuple(files)


def has_bridge(fleet: Fleet, robot: str) -> bool:
    """Whether the robot gets a ROS 1 bridge. Raises InputError for an unknown or unsupported `ros`."""
    computer = fleet.robots[robot].computer
    ros = "" if computer is None else computer.ros
    place = f"robots.{robot}.computer.ros"
    if ros in ROS_TOO_OLD:
        hint = "remove `ros`: no bridge is deployed then"
        raise InputError(f"{place}: the Python of {ros} is older than 3.8, which the bridge needs", hint=hint)
    if ros not in ("", ROS_1, *ROS_2):
        hint = did_you_mean(ros, (ROS_1, *ROS_2)) or "remove `ros`: no bridge is deployed then"
        raise InputError(f"{place}: expected {ROS_1} or a ROS 2 release, found {ros!r}", hint=hint)
    return ros == ROS_1


# Instead of hiding all devices: serial ports of the kinds that radios have, also if they are plugged in later. On
# Debian and Ubuntu the group owns them. systemd leaves out a kind that the kernel does not know
# (systemd.resource-control).
_NO_DEVICES = "PrivateDevices=yes"
_SERIAL_PORTS = "\n".join(
    (
        "DevicePolicy=closed",
        *(f"DeviceAllow=char-{kind} rw" for kind in ("ttyUSB", "ttyACM", "ttyS", "ttyAMA")),
        "SupplementaryGroups=dialout",
    )
)


def _with_serial_ports(fleet: Fleet, robot: str, unit: str) -> str:
    """The daemon's unit, with serial ports if the robot has thin links. Raises ValueError unless it hides devices."""
    ports = fleet.robots[robot].thin
    if ports is None or not ports.ports:
        return unit
    if unit.count(_NO_DEVICES) != 1:
        raise ValueError(f"expected one {_NO_DEVICES} in the unit, found {unit.count(_NO_DEVICES)}")
    return unit.replace(_NO_DEVICES, _SERIAL_PORTS)


def service_unit(stock: str, start: str, after: str = "") -> str:
    """A unit of udp_mesh with the command `start`, and `after` for when it has ended, if the unit has such a command.
    Raises ValueError unless it has exactly these."""
    lines = stock.splitlines()
    commands = {"ExecStart=": start, **({"ExecStopPost=": after} if after else {})}
    for key, command in commands.items():
        places = [number for number, line in enumerate(lines) if line.startswith(key)]
        if len(places) != 1:
            raise ValueError(f"expected one {key[:-1]} in the unit, found {len(places)}")
        lines[places[0]] = f"{key}{command}"
    return "".join(f"{line}\n" for line in lines)
