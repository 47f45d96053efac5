"""Relays: daemons that pass datagrams on and further links of daemons (MC761 to MC767)."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.lint.rules.secrets import identity
from meshctl.model import Computer, ComputerLink, Fleet
from meshctl.render.daemon import LINK_SELECTORS, link_problems
from meshctl.resolve import computer_gateway
from meshctl.wording import join_limited

_ALL = "all"


@fleet_rule(
    "MC761",
    Severity.ERROR,
    "A relay is for a robot that does not exist",
    why="""The daemon knows robots by their names alone and reports no error: it waits for a robot of that name, and
    passes nothing on for the one that was meant.""",
    fix="Use a robot defined in `robots`, or `all`.",
    failing="robots: {husky1: {relay: [base-statoin]}}",
    passing="robots: {husky1: {relay: [base-station]}}",
)
def relay_for_unknown_robot(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        for index, name in enumerate(robot.relay):
            if name != _ALL and name not in fleet.robots:
                expected, hint = suggest((*fleet.robots, _ALL), name)
                yield Finding(("robots", robot.name, "relay", str(index)), "no such robot", expected, name, hint)


@fleet_rule(
    "MC762",
    Severity.WARNING,
    "A robot is a relay for itself",
    why="""A relay passes on what other robots send to each other, never its own datagrams, so the entry has no effect.
    The robot that is to be reached through it is probably missing.""",
    fix="List the robots that are to be reached through this one.",
    failing="robots: {husky1: {relay: [husky1]}}",
    passing="robots: {husky1: {relay: [base-station]}}",
)
def relay_for_itself(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        for index, name in enumerate(robot.relay):
            if name == robot.name:
                path = ("robots", robot.name, "relay", str(index))
                yield Finding(path, "the robot itself", "another robot, or all", name)


@fleet_rule(
    "MC763",
    Severity.ERROR,
    "A robot is a relay, but relays are turned off",
    why="""`relay_hops` limits the links between two robots. With `relay_hops: 1` every robot uses direct links only,
    and the daemon of a relay does not start.""",
    fix="Set `relay_hops` to at least 2, or remove `relay` from the robots.",
    failing="""
    udp_mesh: {relay_hops: 1}
    robots: {husky1: {relay: [all]}}
    """,
    passing="""
    udp_mesh: {relay_hops: 2}
    robots: {husky1: {relay: [all]}}
    """,
)
def relay_without_hops(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    hops = fleet.udp_mesh.relay_hops
    relay = next((robot.name for robot in fleet.robots.values() if robot.relay), None)
    if relay is not None and hops < 2:
        yield Finding(("udp_mesh", "relay_hops"), f"{relay} is a relay", "at least 2", str(hops))


@fleet_rule(
    "MC764",
    Severity.ERROR,
    "A link of a computer selects nothing, or the same as another",
    why="""The daemon finds a link by its interface or by the computer's address there. Two entries for one link are
    rejected, and with them the whole configuration. The link with the computer's `address` is there by itself.""",
    fix="Give each link its own `interface` or `address`, not both.",
    failing="robots: {husky1: {computer: {links: [{interface: wlan1}, {interface: wlan1}]}}}",
    passing="robots: {husky1: {computer: {links: [{interface: wlan1}, {interface: eth1}]}}}",
)
def link_not_found(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        if robot.computer is None:
            continue
        for index, is_repeated, found in link_problems(robot.computer):
            path = ("robots", robot.name, "computer", "links", str(index))
            if is_repeated:
                yield Finding(path, "the same link as another entry", "another interface or address", found)
            else:
                yield Finding(path, "not one link", LINK_SELECTORS, found)


@fleet_rule(
    "MC765",
    Severity.ERROR,
    "A neighbor on a link is no robot of the fleet",
    why="The daemon would send to an address that belongs to no robot of the inventory, or to the robot itself.",
    fix="Use another robot defined in `robots`.",
    failing="robots: {husky1: {computer: {links: [{interface: eth1, neighbors: {base-statoin: 10.50.0.1}}]}}}",
    passing="robots: {husky1: {computer: {links: [{interface: eth1, neighbors: {base-station: 10.50.0.1}}]}}}",
)
def link_to_unknown_robot(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        others = [name for name in fleet.robots if name != robot.name]
        for index, link in enumerate(robot.computer.links if robot.computer is not None else ()):
            for name in link.neighbors:
                if name not in others:
                    path = ("robots", robot.name, "computer", "links", str(index), "neighbors", name)
                    expected, hint = suggest(others, name)
                    yield Finding(path, "no such robot", expected, name, hint)


@fleet_rule(
    "MC766",
    Severity.ERROR,
    "A relay key is also a fleet key",
    why="""Relay keys are given to relays that must not read what they pass on. One that is also a fleet key lets them
    read and send everything.""",
    fix="Generate a separate key: `udp-mesh keygen FILE` or `openssl rand -hex 32`.",
    failing="udp_mesh: {relay_keys: [{env: UDP_MESH_KEY}]}",
    passing="udp_mesh: {relay_keys: [{env: UDP_MESH_RELAY_KEY}]}",
)
def relay_key_is_fleet_key(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    fleet_keys = {identity(context, ref) for ref in fleet.udp_mesh.keys}
    for index, ref in enumerate(fleet.udp_mesh.relay_keys):
        if identity(context, ref) in fleet_keys:
            yield Finding(("udp_mesh", "relay_keys", str(index)), "also a fleet key", "a separate key", str(ref))


@fleet_rule(
    "MC767",
    Severity.WARNING,
    "A robot is reached only through one that is no relay for it",
    why="""The base station and this robot share no network: only another robot has a link to both. A daemon passes on
    nothing unless `relay` names one of the two ends, so neither commands nor an emergency stop arrive.""",
    fix="""Add the robot (or `all`) to `relay` of the robot between, raise `udp_mesh.relay_hops`, or give both ends a
    link in one network.""",
    failing="""
    robots:
      husky1: {computer: {links: [{address: 10.50.0.1}]}}
      uav1: {computer: {address: 10.50.0.2/24, ssh: {user: robot}}}
    """,
    passing="""
    robots:
      husky1: {relay: [uav1], computer: {links: [{address: 10.50.0.1}]}}
      uav1: {computer: {address: 10.50.0.2/24, ssh: {user: robot}}}
    """,
)
def reached_without_relay(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    links = _links(fleet)
    bases = [name for name in links if fleet.robots[name].is_base]
    lacking: dict[tuple[str, str], list[str]] = {}
    too_far: dict[str, int] = {}
    for base, name in ((base, name) for base in bases for name in links if name not in bases):
        ends = {_ALL, base, name}
        relays = {robot.name for robot in fleet.robots.values() if ends & set(robot.relay)}
        path = _shortest_path(links, base, name, relays)
        if path:
            if len(path) - 1 > fleet.udp_mesh.relay_hops > 1:
                too_far[name] = len(path) - 1
            continue
        for between in _shortest_path(links, base, name, set(links))[1:-1]:
            if between not in relays:
                lacking.setdefault((between, base), []).append(name)
    for (between, base), names in lacking.items():
        message = f"only through it are {join_limited(names)} and {base} connected"
        expected = f"{', '.join(names)}, or all"
        yield Finding(("robots", between, "relay"), message, expected, ", ".join(fleet.robots[between].relay) or "none")
    if too_far:
        message = f"{join_limited(tuple(too_far))} cannot be reached from the base station"
        found = str(fleet.udp_mesh.relay_hops)
        yield Finding(("udp_mesh", "relay_hops"), message, f"at least {max(too_far.values())}", found)


def _links(fleet: Fleet) -> dict[str, set[str]]:
    """The robots that each robot's daemon has a link to, by the networks of their computers.

    A link that is given by its interface is in an unknown network: it counts as one to the robots that have no other.
    """
    computers = {name: robot.computer for name, robot in fleet.robots.items() if robot.computer is not None}
    routed = {name for name in computers if computer_gateway(fleet, fleet.robots[name]) is not None}
    found: dict[str, set[str]] = {name: set() for name in computers}
    for name, computer in computers.items():
        for other, peer in computers.items():
            if other != name and ({name, other} <= routed or _share_network(computer, other, peer)):
                found[name].add(other)
                found[other].add(name)
    alone = [name for name, others in found.items() if not others]
    for name, computer in computers.items():
        if any(link.interface and not link.neighbors for link in computer.links):
            for other in alone:
                if other != name:
                    found[name].add(other)
                    found[other].add(name)
    return found


def behind_further_links(fleet: Fleet) -> set[str]:
    """The robots that a further link of another robot's computer leads to: they may have no radio of the fleet."""
    links = _links(fleet)
    computers = {name: robot.computer for name, robot in fleet.robots.items() if robot.computer is not None}
    return {
        name
        for name, computer in computers.items()
        for other in links[name]
        if computers[other].address.ip not in computer.address.network
        and any(_leads_to(link, name, computer) for link in computers[other].links)
    }


def _leads_to(link: ComputerLink, name: str, computer: Computer) -> bool:
    if link.address is not None:
        return link.address in computer.address.network
    return not link.neighbors or name in link.neighbors


def _share_network(computer: Computer, name: str, peer: Computer) -> bool:
    """Whether the first has an address in the network of the second, named `name`, or names it as a neighbor."""
    addresses = [computer.address.ip, *(link.address for link in computer.links if link.address is not None)]
    return any(address in peer.address.network for address in addresses) or any(
        name in link.neighbors for link in computer.links
    )


def _shortest_path(links: Mapping[str, set[str]], start: str, end: str, between: set[str]) -> tuple[str, ...]:
    """The robots from `start` to `end`, all others on the way in `between`; empty if there is no such path."""
    came_from = {start: ""}
    waiting = deque([start])
    while waiting and end not in came_from:
        name = waiting.popleft()
        if name == start or name in between:
            for other in sorted(links[name] - came_from.keys()):
                came_from[other] = name
                waiting.append(other)
    path = [end] if end in came_from else []
    while path and path[-1] != start:
        path.append(came_from[path[-1]])
    return tuple(reversed(path))
