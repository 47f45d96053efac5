"""The robots' computers: architecture, ROS distribution, names for /etc/hosts, the daemons' port (MC631 to MC639)."""

from __future__ import annotations

import re
from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet
from meshctl.model.computers import ARCHITECTURES, ROS_1, ROS_2, ROS_TOO_OLD
from meshctl.wording import join_limited

# one label of a host name (RFC 1123, section 2.1), and not an address
_HOST_LABEL = re.compile(r"(?!\d+$)[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
# Linux, net.ipv4.ip_unprivileged_port_start
_FIRST_OPEN_PORT = 1024
# other names of the same architectures
_ALIASES = {"amd64": "x86_64", "x64": "x86_64", "arm64": "aarch64", "armhf": "armv7l", "i386": "i686"}


@fleet_rule(
    "MC631",
    Severity.WARNING,
    "A computer's architecture is unknown",
    why="""The udp_mesh wheels are chosen by architecture, and deployment refuses a computer that reports another one:
    with a typo, the robot gets no udp_mesh.""",
    fix="Use the output of `uname -m` on the computer.",
    failing="robots: {husky1: {computer: {arch: x86-64}}}",
    passing="robots: {husky1: {computer: {arch: aarch64}}}",
)
def arch_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        arch = "" if robot.computer is None else robot.computer.arch
        if arch and arch not in ARCHITECTURES:
            _, near = suggest(ARCHITECTURES, arch)
            hint = f"write {_ALIASES[arch.lower()]}" if arch.lower() in _ALIASES else near
            path = ("robots", robot.name, "computer", "arch")
            yield Finding(path, "unknown architecture", f"one of {join_limited(ARCHITECTURES)}", arch, hint)


@fleet_rule(
    "MC632",
    Severity.ERROR,
    "A computer's ROS distribution is unknown",
    why="The distribution selects the bridge to deploy. `meshctl robots deploy` refuses a robot with an unknown one.",
    fix="Use the distribution's name (`echo $ROS_DISTRO` on the computer), or remove `ros` to deploy no bridge.",
    failing="robots: {husky1: {computer: {ros: humbel}}}",
    passing="robots: {husky1: {computer: {ros: humble}}}",
)
def ros_unknown(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        ros = "" if robot.computer is None else robot.computer.ros
        path = ("robots", robot.name, "computer", "ros")
        if ros in ROS_TOO_OLD:
            yield Finding(path, "its Python is older than 3.8", f"{ROS_1}, or a ROS 2 distribution", ros)
        elif ros not in ("", ROS_1, *ROS_2):
            _, hint = suggest((ROS_1, *ROS_2), ros)
            yield Finding(path, "unknown ROS distribution", f"{ROS_1}, or a ROS 2 distribution", ros, hint)


@fleet_rule(
    "MC633",
    Severity.WARNING,
    "A robot's name cannot be a host name",
    why="""With `udp_mesh.etc_hosts` the robots' computers get each other's names in /etc/hosts. A name with characters
    other than letters, digits and hyphens is left out, so `ssh` and `ping` do not know that robot.""",
    fix="Rename the robot, or remove `etc_hosts`.",
    failing="""
        udp_mesh: {etc_hosts: true}
        robots:
          husky1: <removed>
          husky_1: {nodes: [husky1-front], carries: [b01], computer: {address: 10.42.0.110/24, ssh: {user: robot}}}
        topics:
          commands: {destinations: [husky_1]}
          artifacts: {sources: [husky_1]}
          map: {sources: [husky_1]}
          video: {sources: [husky_1]}
    """,
    passing="""
        udp_mesh: {etc_hosts: true}
        robots:
          husky1: <removed>
          husky-1: {nodes: [husky1-front], carries: [b01], computer: {address: 10.42.0.110/24, ssh: {user: robot}}}
        topics:
          commands: {destinations: [husky-1]}
          artifacts: {sources: [husky-1]}
          map: {sources: [husky-1]}
          video: {sources: [husky-1]}
    """,
)
def name_is_no_host_name(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    if not fleet.udp_mesh.etc_hosts:
        return
    for robot in fleet.robots.values():
        if robot.computer is not None and not _HOST_LABEL.fullmatch(robot.name):
            expected = "letters, digits and hyphens, at most 63"
            yield Finding(("robots", robot.name), "not a host name", expected, robot.name)


@fleet_rule(
    "MC634",
    Severity.WARNING,
    "A robot's other computers are not monitored",
    why="""The computer that runs the udp_mesh daemon pings the others on the robot's switch. Without one, `meshctl
    status` says nothing about them.""",
    fix="Name the computer that runs the daemon in `computer`.",
    failing="""
        nodes: {husky1-front: {lan_filter: {}}}
        robots:
          husky1: {computer: <removed>, computers: {jetson: {address: 10.42.0.111/24}}}
        topics:
          commands: <removed>
          artifacts: <removed>
          map: <removed>
          video: <removed>
    """,
    passing="""
        nodes: {husky1-front: {lan_filter: {}}}
        robots: {husky1: {computers: {jetson: {address: 10.42.0.111/24}}}}
    """,
)
def others_not_monitored(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computers and robot.computer is None:
            path = ("robots", robot.name, "computers")
            found = join_limited(tuple(robot.computers))
            yield Finding(path, "nothing pings them", "a `computer` that runs the daemon", found)


@fleet_rule(
    "MC639",
    Severity.ERROR,
    "The daemon cannot open its port",
    why="""Ports below 1024 need privileges that the daemon's service does not have: the daemon does not start, and
    `meshctl robots deploy` rolls it back.""",
    fix="Use a port from 1024 on; 8700 is the default.",
    failing="udp_mesh: {port: 700}",
    passing="udp_mesh: {port: 8700}",
)
def port_needs_privileges(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    has_daemons = any(robot.computer is not None for robot in fleet.robots.values())
    for key, port in (("port", fleet.udp_mesh.port), ("metrics_port", fleet.udp_mesh.metrics_port)):
        if has_daemons and port is not None and port < _FIRST_OPEN_PORT:
            yield Finding(("udp_mesh", key), "needs privileges", f"{_FIRST_OPEN_PORT} or more", str(port))
