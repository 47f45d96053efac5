"""A node's values, each with its layer and position."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from meshctl.model import Fleet, Node, Origin, Radio


@dataclass(frozen=True, slots=True)
class ExplainedValue:
    """`key` is the path below the node (`radios.radio0.mesh`); `value` is text for display."""

    key: str
    value: str
    origin: Origin


def explain(fleet: Fleet, node: Node) -> tuple[ExplainedValue, ...]:
    """All values of `node`, in the order of the format. A default value is `built-in`, at the position of its
    container."""
    return tuple(ExplainedValue(key, value, _origin(fleet, node, key)) for key, value in _values(node))


def _values(node: Node) -> Iterator[tuple[str, str]]:
    yield "role", node.role.value
    yield "state", node.state.value
    yield "site", node.site
    yield "hardware", node.hardware.name
    yield "board", node.hardware.board
    yield "release", str(node.release)
    yield "hostname", node.hostname
    yield "address", str(node.address)
    if node.lan_address is not None:
        yield "lan_address", str(node.lan_address)
    for radio in node.radios:
        for key, value in _radio_values(radio):
            yield f"radios.{radio.name}.{key}", value
    yield "lan_ports", _listed(node.lan_ports)
    if node.lan_filter is not None:
        yield "lan_filter.udp_ports", _listed(tuple(map(str, node.lan_filter.udp_ports)))
    yield "ssh.host", node.ssh.host
    yield "ssh.port", str(node.ssh.port)
    yield "ssh.user", node.ssh.user
    yield "ssh.key_files", _listed(node.ssh.key_files)
    yield "ssh.jump", node.ssh.jump
    yield "groups", _listed(node.groups)
    yield "robot", node.robot
    yield "label", node.label
    yield "serial", node.serial
    yield "mac", node.mac
    yield "host_keys", _listed(node.host_keys)
    yield "confirm_window_s", str(node.confirm_window_s)
    yield "packages", _listed((*node.hardware.packages, *node.packages))
    for option, value in node.extra_uci.items():
        yield f"extra_uci.{option}", value
    yield "gateway", "" if node.gateway is None else str(node.gateway)
    if node.position is not None:
        for axis in ("x_m", "y_m", "z_m"):
            value = getattr(node.position, axis)
            yield f"position.{axis}", "" if value is None else f"{value:g}"


def _radio_values(radio: Radio) -> Iterator[tuple[str, str]]:
    yield "mesh", radio.mesh or "(off)"
    yield "tx_power_dbm", str(radio.tx_power_dbm)
    yield "mac", radio.mac
    yield "path", radio.hardware.path
    yield "band", radio.hardware.band.value
    yield "rated_power_dbm", f"{radio.hardware.rated_power_dbm:g}"
    yield "max_drive_dbm", str(radio.hardware.max_drive_dbm)
    yield "amplifier_gain_db", f"{radio.hardware.amplifier_gain_db:g}"
    yield "antenna_gain_dbi", f"{radio.hardware.antenna_gain_dbi:g}"
    yield "cable_loss_db", f"{radio.hardware.cable_loss_db:g}"
    yield "antenna", radio.hardware.antenna.value


def _origin(fleet: Fleet, node: Node, key: str) -> Origin:
    # Names of UCI options contain dots.
    parts = ("extra_uci", key.removeprefix("extra_uci.")) if key.startswith("extra_uci.") else tuple(key.split("."))
    for path in (("nodes", node.name, *parts), ("hardware", node.hardware.name, *parts)):
        written = fleet.provenance.get(path)
        if written is not None:
            return written
    if key == "lan_address":
        return _lan_origin(fleet, node)
    if parts[0] == "radios":
        place = fleet.where("hardware", node.hardware.name, *parts[:2])
        # The drive level defaults to the driver's maximum, the mesh to the only one of the band.
        source = {"tx_power_dbm": "max_drive_dbm", "mesh": "band"}.get(parts[2])
        if source is not None:
            place = fleet.where("hardware", node.hardware.name, *parts[:2], source)
        return Origin(place.position, "built-in")
    return Origin(fleet.where("nodes", node.name).position, "built-in")


def _lan_origin(fleet: Fleet, node: Node) -> Origin:
    robot = next(robot.name for robot in fleet.robots.values() if robot.lan is not None and node.name in robot.nodes)
    path = ("robots", robot, "lan", "addresses", node.name)
    is_written = path in fleet.provenance
    return fleet.where(*path) if is_written else Origin(fleet.where(*path[:3], "network").position, "rule")


def _listed(items: tuple[str, ...]) -> str:
    return ", ".join(items)
