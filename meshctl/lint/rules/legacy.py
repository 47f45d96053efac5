"""Fleets in which some robots still run the legacy transport, `fielded` in the inventory (MC751 to MC754).

The rendered daemon configuration lists every legacy robot as a neighbor; these rules check that they can reach each
other.
"""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Robot

# the port in the source of the legacy program
_LEGACY_PORT = 8700


def _legacy_robots(fleet: Fleet) -> Iterator[Robot]:
    return (robot for robot in fleet.robots.values() if robot.fielded is not None)


@fleet_rule(
    "MC751",
    Severity.ERROR,
    "A legacy robot cannot be discovered without broadcasts",
    why="""Robots with the legacy udp_mesh announce themselves by broadcast, and nothing is sent to a robot that was not
    heard: with `broadcast: false` no daemon ever contacts it.""",
    fix="Keep `broadcast` on until the last robot is migrated.",
    failing="""
    udp_mesh: {broadcast: false}
    robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}
    """,
    passing="robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}",
)
def fielded_without_broadcast(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.udp_mesh.broadcast:
        for robot in _legacy_robots(fleet):
            yield Finding(("udp_mesh", "broadcast"), f"{robot.name} is never discovered", "true", "false")


@fleet_rule(
    "MC752",
    Severity.WARNING,
    "The legacy robots use another port",
    why="""Both programs send and receive on one port. The legacy udp_mesh uses 8700 unless its source was changed; on
    another port the daemons and the legacy robots do not see each other.""",
    fix="Use port 8700, or suppress this finding if the legacy robots were changed to the same port.",
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
            yield Finding(("udp_mesh", "port"), f"{robot.name} is not reachable", str(_LEGACY_PORT), str(port))
            return


@fleet_rule(
    "MC753",
    Severity.WARNING,
    "A robot is both legacy and migrated",
    why="""With `computer` the robot gets a udp_mesh daemon, which the others discover. A leftover `fielded` makes every
    robot keep its broadcasts compatible with a program that is gone, and hides whether the fleet is migrated.""",
    fix="Remove `fielded` when the robot gets a `computer`, and deploy to all robots.",
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
    "A legacy robot is in a different network than a computer",
    why="Legacy robots are discovered by broadcast, which does not leave the network.",
    fix="Use the robot's address in the mesh's network.",
    failing="robots: {husky1: {computer: <removed>, fielded: 10.99.0.110}}",
    passing="robots: {husky1: {computer: <removed>, fielded: 10.42.0.110}}",
)
def fielded_elsewhere(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # MC219 reports robots with a LAN of their own
    bridged = [robot.computer for robot in fleet.robots.values() if robot.computer is not None and robot.lan is None]
    networks = {computer.address.network for computer in bridged}
    for robot in _legacy_robots(fleet):
        apart = sorted(str(network) for network in networks if robot.fielded not in network)
        if apart:
            path = ("robots", robot.name, "fielded")
            yield Finding(
                path, "broadcasts do not reach it", f"an address in {' and '.join(apart)}", str(robot.fielded)
            )
