"""References to meshes, robots, nodes and jump hosts (MC101 to MC109)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Node, Role
from meshctl.suggest import did_you_mean
from meshctl.wording import join_limited

# A fleet may have as many wrong names as nodes: comparing each of them with all names takes too long.
_MAX_COMPARED = 500
_MAX_SHOWN_JUMPS = 8


def suggest(names: Iterable[str], wrong: str) -> tuple[str, str]:
    """The `expected` text and the hint for `wrong`, which is not one of `names`."""
    choices = sorted(names)
    expected = f"one of {join_limited(choices)}" if choices else "nothing, as none are defined"
    return expected, did_you_mean(wrong, choices) if len(choices) <= _MAX_COMPARED else ""


def _unknown(fleet: Fleet, path: tuple[str, ...], names: Sequence[str]) -> Iterator[Finding]:
    """One finding for each list element that expands to names of no node."""
    unknown = dict.fromkeys(name for name in names if name not in fleet.nodes)
    for wrong in group_by_key((fleet.where(*path, name).position, name) for name in unknown).values():
        _, hint = suggest(fleet.nodes, wrong[0])
        members = [node.name for node in fleet.nodes.values() if wrong[0] in node.groups]
        if members:
            hint = f"a group: list its nodes ({join_limited(members)}), or a range of them"
        elif "*" in wrong[0]:
            hint = 'patterns are for commands: list the nodes, or a range such as "b[01-03]"'
        message = "no such node" if len(wrong) == 1 else "no such nodes"
        yield Finding((*path, wrong[0]), message, "names of `nodes`", join_limited(wrong), hint)


# so many robots with a radio that does not exist: the nodes are the mistake
_MANY_ROBOTS = 3


def unmeshed(fleet: Fleet, node: Node) -> str:
    """Why a node without a mesh is in none: the bands of its radios and of the meshes, if they differ."""
    bands = {mesh.band for mesh in fleet.meshes.values()}
    if not node.radios or any(radio.hardware.band in bands for radio in node.radios):
        return "none"
    return f"none: {node.bands_beside(fleet.meshes.values())}"


@fleet_rule(
    "MC101",
    Severity.ERROR,
    "A radio joins a mesh that does not exist",
    why="The radio would be rendered without an interface: the node comes up off the air and unreachable.",
    fix="Use a mesh defined in `meshes`, or `mesh: null` to leave the radio off.",
    failing="nodes: {b01: {radios: {radio0: {mesh: mian}}}}",
    passing="nodes: {b01: {radios: {radio0: {mesh: main}}}}",
)
def unknown_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        for radio in node.radios:
            if radio.mesh is not None and radio.mesh not in fleet.meshes:
                expected, hint = suggest(fleet.meshes, radio.mesh)
                path = ("nodes", node.name, "radios", radio.name, "mesh")
                yield Finding(path, "no such mesh", expected, radio.mesh, hint)


@fleet_rule(
    "MC102",
    Severity.ERROR,
    "A node belongs to a robot that does not exist",
    why="Status, plans and the loop check group nodes by robot; a node of an unknown robot is in no group.",
    fix="Use a robot defined in `robots`.",
    failing="nodes: {b01: {robot: husky9}}",
    passing="nodes: {b01: {robot: husky1}}",
)
def unknown_robot(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        if node.robot and node.robot not in fleet.robots:
            expected, hint = suggest(fleet.robots, node.robot)
            yield Finding(("nodes", node.name, "robot"), "no such robot", expected, node.robot, hint)


@fleet_rule(
    "MC103",
    Severity.ERROR,
    "A robot lists a node that does not exist",
    why="The robot's radio cannot be configured, and its place in the mesh is unknown.",
    fix="Add the node to `nodes`, or correct the name.",
    failing="robots: {husky1: {nodes: [husky1-front, husky1-raer]}}",
    passing="robots: {husky1: {nodes: [husky1-front]}}",
)
def unknown_node_of_robot(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    found = [
        finding
        for robot in fleet.robots.values()
        for finding in _unknown(fleet, ("robots", robot.name, "nodes"), robot.nodes)
    ]
    if len(found) > _MANY_ROBOTS:
        # the range of the nodes has another name
        names = [finding.found for finding in found]
        robots = join_limited([finding.path[1] for finding in found[1:]])
        yield replace(found[0], message=f"no such nodes (also of {robots})", found=join_limited(names))
    else:
        yield from found


@fleet_rule(
    "MC104",
    Severity.ERROR,
    "A robot carries a node that does not exist",
    why="The operator would look for a beacon that does not exist, or carry one that is not configured.",
    fix="Add the beacon to `nodes`, or correct the name.",
    failing="robots: {husky1: {carries: [b01, b0l]}}",
    passing="robots: {husky1: {carries: [b01]}}",
)
def unknown_carried_node(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        yield from _unknown(fleet, ("robots", robot.name, "carries"), robot.carries)


@fleet_rule(
    "MC105",
    Severity.ERROR,
    "A jump host does not exist",
    why="Every command for this node or computer fails before it connects.",
    fix="Name a node in `ssh.jump`, or remove it to connect directly.",
    failing="nodes: {b01: {ssh: {jump: bsae}}}",
    passing="nodes: {b01: {ssh: {jump: base}}}",
)
def unknown_jump(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.nodes.values():
        if node.ssh.jump and node.ssh.jump not in fleet.nodes:
            _, hint = suggest(fleet.nodes, node.ssh.jump)
            path = ("nodes", node.name, "ssh", "jump")
            yield Finding(path, "no such node", "a name of `nodes`", node.ssh.jump, hint)
    for robot in fleet.robots.values():
        for key, _, computer in robot.all_computers():
            if computer.ssh.jump and computer.ssh.jump not in fleet.nodes:
                _, hint = suggest(fleet.nodes, computer.ssh.jump)
                place = ("robots", robot.name, *key, "ssh", "jump")
                yield Finding(place, "no such node", "a name of `nodes`", computer.ssh.jump, hint)


@fleet_rule(
    "MC106",
    Severity.ERROR,
    "Jump hosts form a cycle",
    why="A connection through nodes that jump through each other never reaches its target.",
    fix="Connect to one node of the cycle directly.",
    failing="""
    nodes:
      b01: {ssh: {jump: base}}
      base: {ssh: {jump: b01}}
    """,
    passing="nodes: {b01: {ssh: {jump: base}}}",
)
def jump_circle(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    settled: set[str] = set()
    for node in fleet.nodes.values():
        way: dict[str, None] = {}
        name = node.name
        while name in fleet.nodes and name not in settled and name not in way:
            way[name] = None
            name = fleet.nodes[name].ssh.jump
        if name in way:
            names = list(way)
            circle = [*names[names.index(name) :], name]
            found = " -> ".join(circle[:_MAX_SHOWN_JUMPS]) + (" -> ..." if len(circle) > _MAX_SHOWN_JUMPS else "")
            path = ("nodes", name, "ssh", "jump")
            yield Finding(path, "jump hosts form a cycle", "a node reached directly at the end", found)
        settled.update(way)


@fleet_rule(
    "MC107",
    Severity.WARNING,
    "A mesh has no members",
    why="An unused mesh is usually a leftover or a mistyped name.",
    fix="Let radios join it, or remove it.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      base: {radios: {radio0: {mesh: main}}}
      husky1-front: {radios: {radio0: {mesh: main}}}
      b01: {radios: {radio0: {mesh: main}}}
    """,
    passing="meshes: {main: {channel: 11}}",
)
def empty_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    joined = {mesh for node in fleet.managed() for mesh in node.meshes}
    for name in fleet.meshes:
        if name not in joined:
            yield Finding(("meshes", name), "no managed node joins this mesh", "at least one radio", "none")


@fleet_rule(
    "MC108",
    Severity.WARNING,
    "A managed node joins no mesh",
    why="A node whose radios are all off is reachable by cable only and relays nothing.",
    fix="Assign one of its radios to a mesh, or set its state to `retired`.",
    failing="nodes: {b01: {radios: {radio0: {mesh: null}}}}",
    passing="nodes: {b01: {radios: {radio0: {mesh: main}}}}",
)
def node_without_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if not node.meshes and node.role is not Role.BASE:
            yield Finding(("nodes", node.name), "no radio joins a mesh", "at least one", unmeshed(fleet, node))


@fleet_rule(
    "MC109",
    Severity.NOTE,
    "A hardware profile is unused",
    why="Unused profiles go stale: nothing checks their firmware and hashes.",
    fix="Remove the profile, or use it for the intended nodes.",
    failing="""
    hardware:
      bullet: {board: "ubnt,bullet-m-xw", profile: ubnt_bullet-m-xw, target: ath79/generic, release: "24.10",
               lan_ports: [eth0], recovery: Hold reset at power-on,
               radios: {radio0: {path: platform/ahb/18100000.wmac, band: 2g, rated_power_dbm: 27, max_drive_dbm: 27}}}
    """,
    passing="hardware: {rocket: {memory_mib: 64}}",
)
def unused_hardware(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    used = {node.hardware.name for node in fleet.nodes.values()}
    for name in fleet.hardware:
        if name not in used:
            yield Finding(("hardware", name), "no node uses this profile")
