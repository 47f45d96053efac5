"""Robots' LANs with a subnet of their own: overlaps, addresses, gateways, legacy robots (MC216 to MC220)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import overlaps
from meshctl.lint.places import first_written
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.addresses import lan_address_path, meshes_of, networks
from meshctl.lint.rules.routing import MESHMERIZE, PARTS
from meshctl.model import Backend, Fleet, Robot
from meshctl.model.ip import IpNetwork
from meshctl.wording import join_limited

# the robot of the examples with a LAN of its own
_ROUTED = """
robots:
  husky1: {lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24}}
"""


def _routed(fleet: Fleet) -> Iterator[tuple[Robot, IpNetwork]]:
    return ((robot, robot.lan) for robot in fleet.robots.values() if robot.lan is not None)


@fleet_rule(
    "MC216",
    Severity.ERROR,
    "A robot's LAN overlaps another network",
    why="""Every node has one route per LAN: with overlapping networks, packets to one of them arrive at the other
    robot, or are taken for stations of the mesh and never leave the LAN.""",
    fix="Give each robot's `lan` a subnet of its own, outside the meshes' networks.",
    failing="robots: {husky1: {lan: {network: 10.42.0.128/25}, computer: {address: 10.42.0.140/25}}}",
    passing=_ROUTED,
)
def lan_overlaps(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for entry, before in overlaps(networks(fleet)):
        if "robots" not in (entry[0][0], before[0][0]):
            continue
        (path, network), (path_of_other, other) = (entry, before) if entry[0][0] == "robots" else (before, entry)
        owner = f"mesh {path_of_other[1]}" if path_of_other[0] == "meshes" else f"the LAN of {path_of_other[1]}"
        yield Finding(path, f"overlaps {other} of {owner}", "a separate network", str(network))


@fleet_rule(
    "MC217",
    Severity.ERROR,
    "A radio's address in its robot's LAN is unusable",
    why="""The radio routes between the mesh and the LAN. Outside the LAN's network, or at its network or broadcast
    address, the computer cannot reach it: it has no way to the mesh.""",
    fix="Use a host address of the LAN's network, or remove `addresses`: the radios then get its first addresses.",
    failing="""
    robots:
      husky1: {lan: {network: 10.43.1.0/24, addresses: {husky1-front: 10.43.2.1}}, computer: {address: 10.43.1.10/24}}
    """,
    passing="""
    robots:
      husky1: {lan: {network: 10.43.1.0/24, addresses: {husky1-front: 10.43.1.254}}, computer: {address: 10.43.1.10/24}}
    """,
)
def lan_address_unusable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, lan in _routed(fleet):
        for node in (fleet.nodes[name] for name in dict.fromkeys(robot.nodes) if name in fleet.nodes):
            address = node.lan_address
            if address is not None and (
                address.ip not in lan or address.ip in (lan.network_address, lan.broadcast_address)
            ):
                expected = f"a host address in {lan}"
                yield Finding(lan_address_path(fleet, node), "not a host of the LAN", expected, str(address.ip))


@fleet_rule(
    "MC218",
    Severity.ERROR,
    "A computer's gateway is not a radio of its robot",
    why="""The computer reaches the mesh and the other robots' LANs through its gateway. Only the robot's radios have
    routes there.""",
    fix="Remove `gateway`: it defaults to the radio that routes the robot's LAN. Set the same on the computer.",
    failing="""
    robots:
      husky1: {lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24, gateway: 10.43.1.99}}
    """,
    passing="""
    robots:
      husky1: {lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24, gateway: 10.43.1.1}}
    """,
)
def gateway_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is None or robot.computer.gateway is None:
            continue
        radios = [
            fleet.nodes[name] for name in robot.nodes if name in fleet.nodes and fleet.nodes[name].state.is_managed
        ]
        addresses = [node.address.ip if node.lan_address is None else node.lan_address.ip for node in radios]
        if robot.computer.gateway not in addresses:
            expected = join_limited([str(address) for address in addresses]) or "a radio of the robot"
            path = ("robots", robot.name, "computer", "gateway")
            yield Finding(path, "no radio of the robot has this address", expected, str(robot.computer.gateway))


@fleet_rule(
    "MC219",
    Severity.ERROR,
    "A legacy robot does not hear robots behind a router",
    why="""Robots with the legacy udp_mesh are discovered by broadcast only, which no router forwards: they and the
    robots with a `lan` never meet.""",
    fix="Migrate the robot (`computer` in place of `fielded`) before any robot gets a `lan`.",
    failing="""
    robots:
      base-station: {lan: {network: 10.43.9.0/24}, computer: {address: 10.43.9.10/24}}
      husky1: {computer: <removed>, fielded: 10.42.0.110}
    system: {log_host: 10.43.9.10}
    """,
    passing=_ROUTED,
)
def legacy_behind_router(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    behind = [robot.name for robot, _ in _routed(fleet)]
    for robot in fleet.robots.values():
        if behind and robot.fielded is not None:
            path = ("robots", robot.name, "fielded")
            message = f"broadcasts do not reach {join_limited(behind)}"
            yield Finding(path, message, "a migrated robot with `computer`", str(robot.fielded))


@fleet_rule(
    "MC220",
    Severity.ERROR,
    "A routed LAN is behind another back end than batman-adv",
    why="""The router's interface on the mesh is batman-adv's. meshmerize has no public interface to route from, so
    `meshctl render` refuses the robot's radios.""",
    fix="Remove `lan`, so that the radios bridge the LAN, or use a mesh with batman-adv.",
    failing=Example(MESHMERIZE + _ROUTED, files=PARTS),
    passing=_ROUTED,
)
def lan_without_batman(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, _ in _routed(fleet):
        for node in (fleet.nodes[name] for name in dict.fromkeys(robot.nodes) if name in fleet.nodes):
            holding = [mesh for mesh in meshes_of(fleet, node) if node.address.ip in mesh.network]
            for mesh in holding[:1]:
                if node.state.is_managed and mesh.backend is not Backend.BATMAN:
                    path = first_written(fleet, ("robots", robot.name, "lan"))
                    message = f"{node.name} is in mesh {mesh.name}"
                    yield Finding(path, message, "a mesh with batman-adv", mesh.backend.value)
