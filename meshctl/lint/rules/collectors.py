"""Collectors on the robots' computers, and their keys on the radios (MC635 to MC638)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Example, Finding, fleet_rule
from meshctl.lint.rules.access import RSA_KEY
from meshctl.lint.sshkey import BadKey, parse_authorized_key
from meshctl.model import Computer, Fleet, Node, Robot
from meshctl.wording import join_limited

# a well-formed key for examples, without a known private key
_KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIAECAwQFBgcICQoLDA0ODxAREhMUFRYXGBkaGxwdHh8g collector of husky1"
_WITH_KEY = f"""
        robots: {{husky1: {{computer: {{collector: true, collector_key: "{_KEY}"}}}}}}
    """


def _collectors(fleet: Fleet) -> Iterator[tuple[Robot, Computer]]:
    for robot in fleet.robots.values():
        if robot.computer is not None and robot.computer.collector:
            yield robot, robot.computer


def _radios(fleet: Fleet, robot: Robot) -> list[Node]:
    nodes = (fleet.nodes.get(name) for name in robot.nodes)
    return [node for node in nodes if node is not None and node.state.is_managed]


def _path(robot: Robot, key: str) -> tuple[str, ...]:
    return ("robots", robot.name, "computer", key)


@fleet_rule(
    "MC635",
    Severity.WARNING,
    "A robot's radios do not accept its collector",
    why="Without `collector_key` the collector runs, but its radios refuse it.",
    fix="""Run `meshctl robots deploy`, which generates a key there and writes its public part here. Then provision the
    radios.""",
    failing="robots: {husky1: {computer: {collector: true}}}",
    passing=_WITH_KEY,
)
def collector_without_key(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, computer in _collectors(fleet):
        if not computer.collector_key:
            yield Finding(_path(robot, "collector"), "no collector_key", "the collector's SSH public key", "none")


@fleet_rule(
    "MC636",
    Severity.ERROR,
    "A collector's key is not a public key",
    why="dropbear silently skips a line that it cannot read: the radios refuse the collector.",
    fix="Remove `collector_key` and run `meshctl robots deploy`, which writes it again.",
    failing="""
        robots: {husky1: {computer: {collector: true, collector_key: ssh-ed25519 AAAAC3NzaC1lZDI1NTE5}}}
    """,
    passing=_WITH_KEY,
)
def collector_key_invalid(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, computer in _collectors(fleet):
        if computer.collector_key:
            try:
                parse_authorized_key(computer.collector_key)
            except BadKey as reason:
                yield Finding(_path(robot, "collector_key"), "", "an SSH public key", str(reason))


@fleet_rule(
    "MC637",
    Severity.ERROR,
    "A collector's key may do more than ask for links",
    why="""The key lies on the robot, which may be lost. As the key of an operator, or of a site's worker, it would open
    every radio; as that of two robots, it could not be withdrawn from one of them.""",
    fix="""Remove `collector_key` and, on the computer, /var/lib/udp-mesh/collector, and run `meshctl robots deploy`,
    which generates another key.""",
    failing=f"""
        operators: {{ssh_keys: ["{_KEY}"]}}
        robots: {{husky1: {{computer: {{collector: true, collector_key: "{_KEY}"}}}}}}
    """,
    passing=_WITH_KEY,
)
def collector_key_shared(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    owners = {_text(key): "a key of the operators" for key in fleet.operators.ssh_keys}
    owners |= {_text(site.worker_key): f"the worker's key of {site.name}" for site in fleet.sites.values()}
    owners.pop("", None)
    for robot, computer in _collectors(fleet):
        text = _text(computer.collector_key)
        if text in owners:
            yield Finding(_path(robot, "collector_key"), "", "a key for this collector alone", owners[text])
        elif text:
            owners[text] = f"the key of {robot.name}"


def _text(line: str) -> str:
    """The key without options and comment; empty if there is none."""
    try:
        return parse_authorized_key(line).text
    except BadKey:
        return ""


@fleet_rule(
    "MC638",
    Severity.ERROR,
    "OpenWrt 19.07 does not accept a collector",
    why="dropbear in 19.07 supports RSA only, and the key of a collector is ed25519.",
    fix="Upgrade the robot's radios, or remove `collector`.",
    failing=Example(
        f"""
        nodes: {{husky1-front: {{release: "19.07"}}}}
        meshes: {{main: {{mode: mesh, encryption: sae}}}}
        operators: {{ssh_keys: ["{RSA_KEY}"]}}
        robots: {{husky1: {{computer: {{collector: true, collector_key: "{_KEY}"}}}}}}
        """,
        also=("MC311",),
    ),
    passing=_WITH_KEY,
)
def collector_on_19_07(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot, _ in _collectors(fleet):
        old = [node.name for node in _radios(fleet, robot) if not node.release.has_ed25519]
        if old:
            message = f"{join_limited(old)} cannot accept it"
            yield Finding(_path(robot, "collector"), message, "OpenWrt 21.02 or newer", "19.07")
