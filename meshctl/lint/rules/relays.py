"""Relays: daemons that pass datagrams on (MC761 to MC763)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import suggest
from meshctl.model import Fleet

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
