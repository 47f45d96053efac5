"""Robots and roles: assignment of nodes, connectivity to the base (MC601 to MC619)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Position, Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, group_by_key
from meshctl.lint.places import first_written
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.references import unmeshed
from meshctl.lint.rules.relays import behind_further_links
from meshctl.model import Fleet, NodeState, Role
from meshctl.wording import counted, join_limited


@fleet_rule(
    "MC601",
    Severity.ERROR,
    "A mesh has no route to the base",
    why="""Its nodes can reach each other but not the operator: no node, and no robot with radios in several meshes,
    connects it to the base station's mesh.""",
    fix="Give the base a radio in this mesh, or a robot radios in both meshes.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 2g, channel: 11, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      base: {radios: {radio0: {mesh: main}}}
      husky1-front: {radios: {radio0: {mesh: main}}}
      b01: {address: 10.43.0.101, radios: {radio0: {mesh: second}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 2g, channel: 11, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      base: {radios: {radio0: {mesh: main}}}
      husky1-front: {radios: {radio0: {mesh: main}}}
      b01: {address: 10.43.0.101, radios: {radio0: {mesh: second}}}
      base2: {role: base, address: 10.43.0.1, radios: {radio0: {mesh: second}}}
    robots: {base-station: {nodes: [base, base2]}}
    """,
)
def mesh_cut_off(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    reached = reached_from_base(fleet)
    if not reached:
        return
    members_of = group_by_key((mesh, node.name) for node in fleet.managed() for mesh in node.meshes)
    for name in fleet.meshes:
        members = members_of.get(name, ())
        if members and name not in reached:
            path = ("meshes", name)
            message = f"{counted(len(members), 'node')} ({join_limited(members)}) cannot reach the base"
            yield Finding(path, message, f"a radio in {join_limited(sorted(reached))} as well", "none")


def reached_from_base(fleet: Fleet) -> set[str]:
    """The base's meshes, and those connected to them by a node or robot that is in both."""
    start = {
        mesh
        for node in fleet.managed()
        if node.role is Role.BASE or (node.robot in fleet.robots and fleet.robots[node.robot].is_base)
        for mesh in node.meshes
    }
    joints: list[set[str]] = [set(node.meshes) for node in fleet.managed() if len(node.meshes) > 1]
    for robot in fleet.robots.values():
        nodes = [fleet.nodes[name] for name in robot.nodes if name in fleet.nodes]
        joints.append({mesh for node in nodes if node.state.is_managed for mesh in node.meshes})
    joints_of = group_by_key((mesh, joint) for joint in joints for mesh in joint)
    reached: set[str] = set()
    waiting = list(start)
    while waiting:
        mesh = waiting.pop()
        if mesh not in reached:
            reached.add(mesh)
            # follow each joint once, from the first of its meshes that is reached
            for joint in joints_of.pop(mesh, []):
                waiting.extend(joint - reached)
    return reached


@fleet_rule(
    "MC602",
    Severity.ERROR,
    "The fleet has no base node",
    why="""Plans order nodes by their distance from the operator, so that the path to them stays up until the end.
    Without a base node there is no such order.""",
    fix="Set `role: base` on the operator's radio.",
    failing="nodes: {base: {role: robot}}",
    passing="nodes: {base: {role: base}}",
)
def no_base(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    managed = list(fleet.managed())
    if managed and not any(node.role is Role.BASE for node in managed):
        yield Finding(("nodes",), "no node has the role base", "a node with `role: base`", "none")


@fleet_rule(
    "MC603",
    Severity.WARNING,
    "The mesh has too few beacons",
    why="The relay chain will not reach the planned depth, and there is no reserve for a failed beacon.",
    fix="Add beacons, mark repaired ones as `carried`, or lower `min_beacons`.",
    failing="meshes: {main: {min_beacons: 3}}",
    passing="meshes: {main: {min_beacons: 1}}",
)
def too_few_beacons(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    ready = group_by_key(
        (mesh, node.name)
        for node in fleet.managed()
        if node.role is Role.BEACON and node.state is not NodeState.SPARE
        for mesh in node.meshes
    )
    for mesh in fleet.meshes.values():
        count = len(ready.get(mesh.name, []))
        if count < mesh.min_beacons:
            path = ("meshes", mesh.name, "min_beacons")
            yield Finding(path, "too few beacons", f"at least {mesh.min_beacons}", f"{count} carried or deployed")


@fleet_rule(
    "MC604",
    Severity.ERROR,
    "Two robots are the base station",
    why="udp_mesh sends messages for the base to one peer; with two, half of the reports go to the wrong one.",
    fix="Set `is_base: true` on one robot only.",
    failing="robots: {husky1: {is_base: true}}",
    passing="robots: {husky1: {is_base: false}}",
)
def two_bases(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    bases = [robot.name for robot in fleet.robots.values() if robot.is_base]
    for name in bases[1:]:
        yield Finding(
            ("robots", name, "is_base"), f"{bases[0]} is also the base station", "one base station", join_limited(bases)
        )


@fleet_rule(
    "MC605",
    Severity.ERROR,
    "Two robots claim one node",
    why="A radio is on one robot: the loop check, the order of changes and the status of both would be wrong.",
    fix="Keep the node on the robot that it is mounted on.",
    failing="robots: {base-station: {nodes: [base, husky1-front]}}",
    passing="robots: {base-station: {nodes: [base]}}",
)
def node_of_two_robots(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # a radio mounted on one robot and carried by another belongs to a carried robot, such as a UAV
    claims = (
        ((key, name), robot.name)
        for robot in fleet.robots.values()
        for key, names in (("nodes", robot.nodes), ("carries", robot.carries))
        for name in names
    )
    claimed: dict[tuple[str, str, str, Position], list[str]] = {}
    for (key, name), (first, *others) in duplicates(claims):
        for robot in others:
            claimed.setdefault((first, robot, key, fleet.where("robots", robot, key, name).position), []).append(name)
    for (first, robot, key, _), names in claimed.items():
        # one finding for a range
        message = f"{join_limited(names)} {'is' if len(names) == 1 else 'are'} already claimed by {first}"
        yield Finding(("robots", robot, key, names[0]), message, "one robot per node", join_limited(names))
    for robot_name, name in _own_nodes_carried(fleet):
        message = f"{name} is mounted on {robot_name} itself"
        yield Finding(("robots", robot_name, "carries", name), message, "either `nodes` or `carries`", name)


def _own_nodes_carried(fleet: Fleet) -> Iterator[tuple[str, str]]:
    for robot in fleet.robots.values():
        mounted = set(robot.nodes)
        yield from ((robot.name, name) for name in dict.fromkeys(robot.carries) if name in mounted)


def _mounted(fleet: Fleet) -> set[str]:
    """The nodes that a robot lists under `nodes`."""
    return {name for robot in fleet.robots.values() for name in robot.nodes}


@fleet_rule(
    "MC606",
    Severity.ERROR,
    "A node and a robot disagree about the node's robot",
    why="""The node names one robot, but another robot lists it: one of the two was not updated when the radio was
    moved.""",
    fix="Define it in one place: omit `robot` on the node, or correct the robot's list.",
    failing="nodes: {husky1-front: {robot: base-station}}",
    passing="nodes: {husky1-front: {robot: husky1}}",
)
def robot_disagrees(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for robot in fleet.robots.values():
        for name in dict.fromkeys((*robot.nodes, *robot.carries)):
            node = fleet.nodes.get(name)
            if node is not None and node.robot and node.robot != robot.name and node.robot in fleet.robots:
                listing = fleet.robots[node.robot]
                if name not in listing.nodes and name not in listing.carries:
                    path = ("nodes", name, "robot")
                    yield Finding(path, f"{robot.name} lists the node", robot.name, node.robot)


@fleet_rule(
    "MC607",
    Severity.WARNING,
    "A robot carries a node that is not a beacon",
    why="""Carried nodes are deployed on the way: beacons, or the radio of a carried robot (such as a UAV) that has its
    own entry. A base radio, or a robot's radio that no robot lists under `nodes`, is probably a mistake.""",
    fix="List beacons and radios of carried robots under `carries`, and mounted radios under `nodes`.",
    failing="""
    nodes: {extra: {role: robot, address: 10.42.0.60, robot: husky1}}
    robots: {husky1: {carries: [b01, extra]}}
    """,
    passing="""
    nodes: {uav1-radio: {role: robot, state: carried, address: 10.42.0.60}}
    robots:
      uav1: {nodes: [uav1-radio], computer: {address: 10.42.0.61/24, ssh: {user: robot}}}
      husky1: {carries: [b01, uav1-radio]}
    """,
)
def carries_no_beacon(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    mounted = _mounted(fleet)
    for robot in fleet.robots.values():
        for name in robot.carries:
            node = fleet.nodes.get(name)
            is_brought = node is not None and node.role is Role.ROBOT and name in mounted and name not in robot.nodes
            if node is not None and node.role is not Role.BEACON and not is_brought:
                path = ("robots", robot.name, "carries", name)
                yield Finding(path, f"{name} is not a beacon", "a node with role beacon", node.role.value)


@fleet_rule(
    "MC608",
    Severity.WARNING,
    "A carried beacon is on no robot",
    why="""A `carried` beacon may be off and raises no alarm. If no robot carries it, its absence is noticed only when
    it is needed.""",
    fix="List it under a robot's `carries`, or set its state to `spare`.",
    failing="nodes: {b02: {role: beacon, state: carried, address: 10.42.0.102}}",
    passing="""
    nodes: {b02: {role: beacon, state: carried, address: 10.42.0.102}}
    robots: {husky1: {carries: [b01, b02]}}
    """,
)
def carried_by_nobody(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    carried = {name for robot in fleet.robots.values() for name in robot.carries}
    for node in fleet.nodes.values():
        is_carried = node.state is NodeState.CARRIED and node.role is Role.BEACON
        if is_carried and fleet.robots and node.name not in carried and node.robot not in fleet.robots:
            yield Finding(("nodes", node.name), "no robot carries it", "a robot that lists it", "none")


@fleet_rule(
    "MC609",
    Severity.WARNING,
    "A robot has no radio",
    why="""Without a managed node, nothing is known about the robot's way into the mesh: plans and `status` do not see
    what a change or a failure cuts off, and if it has no other way, it cannot be stopped.""",
    fix="""List its radio under `nodes`; a lost node does not count. None is needed by a robot that another one names in
    `relay` or reaches by a further link of its computer (`links`), one with a thin link (`thin`), and a legacy one
    (`fielded`). If its radio is not managed by meshctl, suppress this finding.""",
    failing="""
    nodes: {husky1-front: {state: lost}}
    """,
    passing="nodes: {husky1-front: {state: carried}}",
)
def robot_without_radio(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    linked = behind_further_links(fleet) | {name for robot in fleet.robots.values() for name in robot.relay}
    for robot in fleet.robots.values():
        known = [fleet.nodes[name] for name in robot.nodes if name in fleet.nodes]
        is_reached_otherwise = robot.name in linked or robot.thin is not None or robot.fielded is not None
        if not robot.nodes and is_reached_otherwise:
            continue
        if len(known) == len(robot.nodes) and not any(node.state.is_managed for node in known):
            found = join_limited([f"{node.name} ({node.state.value})" for node in known]) or "none"
            base = fleet.base_node if robot.is_base else None
            expected = f"the base's radio, {base.name}" if base is not None else "at least one managed node"
            yield Finding(("robots", robot.name), "no radio is in use", expected, found)


@fleet_rule(
    "MC610",
    Severity.WARNING,
    "A node's role and its robot do not match",
    why="""A node with `role: robot` moves together with everything behind it. Without its robot, lint cannot detect
    loops, and plans cannot determine what a change disconnects. A radio that a robot has under `nodes`, but with the
    role of a beacon (the default), is counted and marked as one. Hops are counted, and plans start, from a base.""",
    fix="List a robot's radio under its `nodes`, with `role: robot`; list beacons under `carries`.",
    failing="nodes: {stray: {role: robot, state: carried, address: 10.42.0.77}}",
    passing="""
    nodes: {stray: {role: robot, address: 10.42.0.77}}
    robots: {husky1: {nodes: [husky1-front, stray]}}
    """,
)
def role_without_robot(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    mounted_on = {name: robot.name for robot in fleet.robots.values() for name in robot.nodes}
    stations = [robot.name for robot in fleet.robots.values() if robot.is_base]
    for node in fleet.managed():
        # a spare waits for the robot whose radio fails
        if node.role is Role.ROBOT and not node.robot and fleet.robots and node.state is not NodeState.SPARE:
            yield Finding(("nodes", node.name), "belongs to no robot", "a robot that lists it", "none")
        elif node.role is Role.BEACON and node.name in mounted_on:
            path = first_written(fleet, ("nodes", node.name, "role"), ("nodes", node.name))
            message = f"{mounted_on[node.name]} lists it as its radio"
            yield Finding(path, message, "role: robot, or base for the base station", node.role.value)
        elif node.role is Role.BASE and stations and mounted_on.get(node.name, stations[0]) not in stations:
            message = f"it is a radio of {mounted_on[node.name]}, which is not the base station"
            yield Finding(("nodes", node.name, "role"), message, "role: robot", node.role.value)


@fleet_rule(
    "MC611",
    Severity.WARNING,
    "The base is not deployed",
    why="All nodes are reached through the base. As `carried` or `spare` it may be off without an alarm.",
    fix="Set its state to `deployed`.",
    failing="nodes: {base: {state: spare}}",
    passing="nodes: {base: {state: deployed}}",
)
def base_not_deployed(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    bases = [node for node in fleet.managed() if node.role is Role.BASE]
    if bases and not any(node.state is NodeState.DEPLOYED for node in bases):
        path = ("nodes", bases[0].name, "state")
        yield Finding(path, "all other nodes are reached through it", "deployed", bases[0].state.value)


@fleet_rule(
    "MC612",
    Severity.ERROR,
    "A jump host is not in use",
    why="The jump host is lost, retired or spare: the node behind it cannot be reached.",
    fix="Use a deployed node as the jump host.",
    failing="""
    nodes:
      old: {role: beacon, state: lost, address: 10.42.0.66}
      b01: {ssh: {jump: old}}
    """,
    passing="nodes: {b01: {ssh: {jump: base}}}",
)
def jump_not_in_use(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    idle = (NodeState.LOST, NodeState.RETIRED, NodeState.SPARE)
    for node in fleet.managed():
        jump = fleet.nodes.get(node.ssh.jump)
        if jump is not None and jump.state in idle:
            path = ("nodes", node.name, "ssh", "jump")
            yield Finding(path, f"{jump.name} is not in use", "a deployed node", jump.state.value)


@fleet_rule(
    "MC617",
    Severity.WARNING,
    "A robot in a topic has no computer",
    why="udp_mesh runs on the robot's computer: messages from or to a robot without one are never delivered.",
    fix="Give the robot a `computer`, or `fielded` while it runs the legacy udp_mesh, or remove it from the topic.",
    failing="robots: {husky1: {computer: <removed>}}",
    passing="robots: {husky1: {computer: {python: python3}}}",
)
def peer_without_computer(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for topic in fleet.topics:
        for key, names in (("sources", topic.sources), ("destinations", topic.destinations)):
            for index, name in enumerate(names):
                robot = fleet.robots.get(name)
                if robot is not None and robot.computer is None and robot.fielded is None:
                    path = ("topics", topic.name, key, str(index))
                    yield Finding(path, f"{name} does not run udp_mesh", "a robot with a computer", name)


@fleet_rule(
    "MC618",
    Severity.WARNING,
    "No robot is the base station",
    why="""No computer is marked as the operator's: status cannot report which robots reach the base, and preflight
    cannot check the emergency stop.""",
    fix="Set `is_base: true` on the robot entry of the operator's computer.",
    failing="robots: {base-station: {is_base: false}}",
    passing="robots: {base-station: {is_base: true}}",
)
def no_base_station(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    has_computers = any(robot.computer is not None for robot in fleet.robots.values())
    if has_computers and not any(robot.is_base for robot in fleet.robots.values()):
        # an explicit `is_base: false`, if there is one
        path = first_written(fleet, *(("robots", name, "is_base") for name in fleet.robots), ("robots",))
        yield Finding(path, "no robot is the base station", "one robot with `is_base: true`", "none")


@fleet_rule(
    "MC619",
    Severity.ERROR,
    "The base joins no mesh",
    why="Every path to the fleet starts at the base. Without a radio in a mesh, nothing behind it can be reached.",
    fix="Set `mesh` on one of its radios.",
    failing="nodes: {base: {radios: {radio0: {mesh: null}}}}",
    passing="nodes: {base: {radios: {radio0: {mesh: main}}}}",
)
def base_without_mesh(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for node in fleet.managed():
        if node.role is Role.BASE and not node.meshes:
            yield Finding(("nodes", node.name), "no radio joins a mesh", "at least one", unmeshed(fleet, node))
