"""Fleets in which some robots still run the fielded transport (MC751 to MC754).

Every robot with a daemon gets a neighbour entry for each of them when its configuration is rendered; what is left to go
wrong is that they cannot hear each other.
"""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Robot

# what the fielded program uses unless somebody changed its source
_LEGACY_PORT = 8700


def _legacy_robots(fleet: Fleet) -> Iterator[Robot]:
    return (robot for robot in fleet.robots.values() if robot.fielded is not None)


@fleet_rule(
    "MC751",
    Severity.ERROR,
    "A fielded robot cannot be heard without broadcasts",
    why="""Robots with the fielded program announce themselves by broadcast, and nothing is sent to one that was not
    heard: with `broadcast: false` no daemon ever talks to it.""",
    fix="Leave `broadcast` on until the last robot has moved over.",
    failing="""
    udp_mesh: {broadcast: false}
    robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}
    """,
    passing="robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}",
)
def fielded_without_broadcast(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.udp_mesh.broadcast:
        for robot in _legacy_robots(fleet):
            yield Finding(("udp_mesh", "broadcast"), f"{robot.name} is never heard", "true", "false")


@fleet_rule(
    "MC752",
    Severity.WARNING,
    "The fielded robots use another port",
    why="""Both programs hear and are heard on one port. The fielded one's is 8700 unless somebody changed it; on
    another port the daemons and it do not notice each other.""",
    fix="Use port 8700, or suppress this with the reason that the fielded robots were given the same port.",
    failing="""
    udp_mesh: {port: 8701}
    robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}
    """,
    passing="""
    udp_mesh: {port: 8700}
    robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}
    """,
)
def fielded_port(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    port = fleet.udp_mesh.port
    for robot in _legacy_robots(fleet):
        if port != _LEGACY_PORT:
            yield Finding(("udp_mesh", "port"), f"{robot.name} is not there", str(_LEGACY_PORT), str(port))
            return


@fleet_rule(
    "MC753",
    Severity.WARNING,
    "A robot is fielded and has moved over",
    why="""With `computer` it gets a daemon of ours, which the others find. What is left of `fielded` has every robot go
    on covering its broadcasts for a program that is not there, and nobody can tell whether the fleet has moved.""",
    fix="Take `fielded` out when the robot gets a `computer`, and deploy to all robots.",
    failing="robots: {husky1: {fielded: 10.42.0.110}}",
    passing="robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}",
)
def fielded_and_moved(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in _legacy_robots(fleet):
        if robot.computer is not None:
            path = ("robots", robot.name, "fielded")
            yield Finding(path, "", "either `fielded` or `computer`", "both")


@fleet_rule(
    "MC754",
    Severity.ERROR,
    "A fielded robot is in another network than a computer",
    why="Broadcasts, by which the fielded program is found, end at the network's border.",
    fix="Write the address that the robot has in the mesh's network.",
    failing="robots: {husky1: {computer: <removed>, fielded: 10.99.0.110}}",
    passing="robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}",
)
def fielded_elsewhere(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    networks = {robot.computer.address.network for robot in fleet.robots.values() if robot.computer is not None}
    for robot in _legacy_robots(fleet):
        apart = sorted(str(network) for network in networks if robot.fielded not in network)
        if apart:
            path = ("robots", robot.name, "fielded")
            yield Finding(path, "no broadcast reaches it", f"an address in {' and '.join(apart)}", str(robot.fielded))
