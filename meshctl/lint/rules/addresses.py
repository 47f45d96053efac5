"""Addresses: unique, inside their network, reachable (MC201 to MC214)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from ipaddress import IPv4Address, ip_address

from meshctl.diagnostics import Position, Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates, overlaps
from meshctl.lint.places import first_written
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.model import Fleet, Mesh, Node
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork, host_and_port
from meshctl.wording import join_limited

# so many nodes of a mesh, and half of them, outside its network: the network is wrong, not each address
_WRONG_NETWORK_NODES = 3
# a network that is larger by more bits is not suggested: the addresses are wrong, not too many
_MAX_MISSING_BITS = 4
# address of a factory-fresh OpenWrt device
_FACTORY = IPv4Address("192.168.1.1")
# RFC 1123, and underscores, which some networks' own names have
_LABEL = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_-]{0,61}[A-Za-z0-9_])?", re.ASCII)
_MAX_HOST_CHARACTERS = 253


def meshes_of(fleet: Fleet, node: Node) -> list[Mesh]:
    return [fleet.meshes[name] for name in node.meshes if name in fleet.meshes]


@fleet_rule(
    "MC201",
    Severity.ERROR,
    "Two stations have the same address",
    why="""Both answer ARP, and traffic goes to the one that answered last: nodes appear and disappear, and changes
    reach the wrong one.""",
    fix="Give each node and each computer a unique address.",
    failing="nodes: {b01: {address: 10.42.0.1}}",
    passing="nodes: {b01: {address: 10.42.0.102}}",
)
def address_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # by place: a range that overlaps another is one mistake
    at: dict[Position, dict[str, list[tuple[tuple[str, ...], str, IpAddress]]]] = {}
    lans = _overlapping_lans(fleet)
    for address, owners in duplicates(stations(fleet)):
        (first_path, first), *later = owners
        for path, name in later:
            if first_path[1] in lans and path[1] in lans and first_path[0] == path[0] == "robots":
                continue  # MC216 reports the LANs
            at.setdefault(fleet.where(*path).position, {}).setdefault(first, []).append((path, name, address))
    for by_first in at.values():
        if len(by_first) == 1:
            for first, later_ones in by_first.items():
                for path, _, address in later_ones:
                    yield Finding(path, f"{first} has the same address", "a unique address", str(address))
            continue
        taken = [one for ones in by_first.values() for one in ones]
        message = f"{join_limited([name for _, name, _ in taken])} have the addresses of {join_limited(list(by_first))}"
        found = join_limited([str(address) for _, _, address in taken])
        yield Finding(taken[0][0], message, "unique addresses", found)


def _overlapping_lans(fleet: Fleet) -> frozenset[str]:
    """The robots whose LANs overlap that of another one."""
    lans = ((robot.name, robot.lan) for robot in fleet.robots.values() if robot.lan is not None)
    return frozenset(name for pair in overlaps(lans) for name, _ in pair)


def stations(fleet: Fleet) -> Iterator[tuple[IpAddress, tuple[tuple[str, ...], str]]]:
    for node in fleet.managed():
        yield node.address.ip, (("nodes", node.name, "address"), node.name)
        if node.lan_address is not None:
            yield node.lan_address.ip, (lan_address_path(fleet, node), node.name)
    for robot in fleet.robots.values():
        for place, what, computer in robot.all_computers():
            yield computer.address.ip, (("robots", robot.name, *place, "address"), what)
            for index, link in enumerate(computer.links):
                if link.address is not None and link.address != computer.address.ip:
                    path = ("robots", robot.name, *place, "links", str(index), "address")
                    yield link.address, (path, f"a link of {what}")
        if robot.computer is None and robot.fielded is not None:
            yield robot.fielded, (("robots", robot.name, "fielded"), f"the computer of {robot.name}")


def lan_address_path(fleet: Fleet, node: Node) -> tuple[str, ...]:
    """Where a radio's address in its robot's LAN is set, or the LAN that it is computed from."""
    name = next((robot.name for robot in fleet.robots.values() if robot.lan and node.name in robot.nodes), node.robot)
    lan = ("robots", name, "lan")
    return first_written(fleet, (*lan, "addresses", node.name), (*lan, "network"))


def networks(fleet: Fleet) -> Iterator[tuple[tuple[str, ...], IpNetwork]]:
    """The networks of the fleet with their paths: the meshes', then the robots' own LANs."""
    for mesh in fleet.meshes.values():
        yield ("meshes", mesh.name, "network"), mesh.network
    for robot in fleet.robots.values():
        if robot.lan is not None:
            yield ("robots", robot.name, "lan", "network"), robot.lan


@fleet_rule(
    "MC202",
    Severity.ERROR,
    "A node's address is outside its mesh's network",
    why="Its neighbors have no route to it: after the change the node is unreachable and rolls back.",
    fix="Use an address in the network of one of its meshes.",
    failing="nodes: {b01: {address: 10.43.0.7}}",
    passing="nodes: {b01: {address: 10.42.0.7}}",
)
def address_outside(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    wrong = wrong_networks(fleet)
    at: dict[Position, list[Node]] = {}
    for name, nodes in _outside(fleet).items():
        mesh = fleet.meshes[name]
        if name in wrong:
            # one typo in the network, rather than one in each address
            message = f"contains no address of {join_limited([node.name for node in nodes])}"
            expected = _network_with(mesh.network, [node.address.ip for node in nodes])
            yield Finding(("meshes", name, "network"), message, expected, str(mesh.network))
            continue
        for node in nodes:
            at.setdefault(fleet.where("nodes", node.name, "address").position, []).append(node)
    for nodes in at.values():
        networks_of_node = dict.fromkeys(str(mesh.network) for mesh in meshes_of(fleet, nodes[0]))
        expected = f"an address in {' or '.join(networks_of_node)}"
        message = "outside its mesh's network"
        if len(nodes) > 1:
            # the rule of a range
            message = f"{join_limited([node.name for node in nodes])} are outside their mesh's network"
        found = join_limited([str(node.address.ip) for node in nodes])
        yield Finding(("nodes", nodes[0].name, "address"), message, expected, found)


def _network_with(network: IpNetwork, addresses: list[IpAddress]) -> str:
    """The network that is expected instead: a larger one if addresses just exceed it, as those of a long range do."""
    first, last = addresses[0], addresses[-1]
    ends = f"{first} to {last}" if len(addresses) > 1 else f"{first}"
    larger = network
    while larger.prefixlen > max(network.prefixlen - _MAX_MISSING_BITS, 0):
        larger = larger.supernet()
        if all(address in larger for address in addresses):
            return f"a network with {ends}, such as {larger}"
    return f"a network with {first}"


def _outside(fleet: Fleet) -> dict[str, list[Node]]:
    """The nodes whose address is in none of their meshes' networks, by their first mesh."""
    outside: dict[str, list[Node]] = {}
    for node in fleet.managed():
        meshes = meshes_of(fleet, node)
        if meshes and not any(node.address.ip in mesh.network for mesh in meshes):
            outside.setdefault(meshes[0].name, []).append(node)
    return outside


def wrong_networks(fleet: Fleet) -> frozenset[str]:
    """The meshes whose `network` is the mistake, because half of their stations or more are outside; addresses of rules
    with `network` are in any."""
    outside = _outside(fleet)
    if not outside:
        return frozenset()
    # computers are addressed like the radios that bridge them
    inside = {name: [node.address.ip in fleet.meshes[name].network for node in fleet.members(name)] for name in outside}
    for robot in fleet.robots.values():
        for name in {mesh for node in robot.nodes if node in fleet.nodes for mesh in fleet.nodes[node].meshes[:1]}:
            if name in inside and robot.lan is None:
                computers = (computer for _, _, computer in robot.all_computers())
                inside[name] += [computer.address.ip in fleet.meshes[name].network for computer in computers]
    return frozenset(
        name
        for name, nodes in outside.items()
        if len(nodes) >= _WRONG_NETWORK_NODES and 2 * inside[name].count(False) >= len(inside[name])
    )


def overlapping_meshes(fleet: Fleet) -> frozenset[str]:
    """Meshes whose networks overlap, but differ: MC205 reports them, and findings about addresses there follow."""
    pairs = overlaps((mesh, mesh.network) for mesh in fleet.meshes.values())
    return frozenset(name for (mesh, one), (other, two) in pairs if one != two for name in (mesh.name, other.name))


@fleet_rule(
    "MC203",
    Severity.ERROR,
    "An address is the network or broadcast address",
    why="The kernel rejects the address, or drops traffic to it.",
    fix="Use a host address of the network.",
    failing="nodes: {b01: {address: 10.42.0.255}}",
    passing="nodes: {b01: {address: 10.42.0.254}}",
)
def address_reserved(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # MC202 reports those outside, with the network that they are not in
    outside = {node.name for nodes in _outside(fleet).values() for node in nodes}
    wrong = wrong_networks(fleet)
    for node in fleet.managed():
        if node.name not in outside and not wrong.intersection(node.meshes):
            yield from _reserved(("nodes", node.name, "address"), node.address)
    for robot in fleet.robots.values():
        for place, _, computer in robot.all_computers():
            yield from _reserved(("robots", robot.name, *place, "address"), computer.address)


def _reserved(path: tuple[str, ...], address: IpInterface) -> Iterator[Finding]:
    # computed directly: ipaddress would take longer for the two ends than all other rules for the node
    host_bits = address.max_prefixlen - address.network.prefixlen
    host_mask = (1 << host_bits) - 1
    # IPv6 has no broadcast address; its network address is every router's (RFC 4291, 2.6.1)
    ends = (0, host_mask) if address.version == 4 else (0,)
    if host_bits >= 2 and int(address.ip) & host_mask in ends:
        network = address.network
        expected = f"one of {network.network_address + 1} to {network.broadcast_address - 1}"
        yield Finding(path, "not a host address", expected, str(address.ip))


@fleet_rule(
    "MC204",
    Severity.ERROR,
    "A node's gateway is unreachable",
    why="The kernel rejects a gateway outside the node's network; a node that is its own gateway sends nothing.",
    fix="Use the address of another station in the same network.",
    failing="nodes: {b01: {gateway: 10.99.0.1}}",
    passing="nodes: {b01: {gateway: 10.42.0.100}}",
)
def gateway_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    unclear = overlapping_meshes(fleet)
    for node in fleet.managed():
        if node.gateway is None:
            continue
        is_itself = any(node.gateway == address.ip for address in node.addresses)
        if not is_itself and unclear.intersection(node.meshes):
            continue
        if is_itself or not any(node.gateway in address.network for address in node.addresses):
            message = "it is the node's own address" if is_itself else "not reachable from the node"
            expected = f"another station in {' or '.join(str(address.network) for address in node.addresses)}"
            hint = "Write `gateway: null` at this node, or in a group of the nodes with an uplink." if is_itself else ""
            yield Finding(("nodes", node.name, "gateway"), message, expected, str(node.gateway), hint)


@fleet_rule(
    "MC206",
    Severity.WARNING,
    "The network contains the factory address 192.168.1.1",
    why="""A device in failsafe mode or after a reset answers at 192.168.1.1: in the fleet's network it conflicts with
    the node that has that address, or is mistaken for a fleet node.""",
    fix="Use another network, such as 10.42.0.0/24.",
    failing="""
    meshes: {main: {network: 192.168.1.0/24}}
    nodes: {base: {address: 192.168.1.2}, husky1-front: {address: 192.168.1.11}, b01: {address: 192.168.1.101}}
    robots: {base-station: {computer: {address: 192.168.1.100/24}}, husky1: {computer: {address: 192.168.1.110/24}}}
    """,
    passing="meshes: {main: {network: 10.42.0.0/24}}",
)
def factory_address(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for path, network in networks(fleet):
        if _FACTORY in network:
            message = f"contains {_FACTORY}, the address of factory-fresh devices"
            yield Finding(path, message, "another network", str(network))


@fleet_rule(
    "MC209",
    Severity.ERROR,
    "A robot's computer is in a different network than its radios",
    why="""The radios bridge the mesh to the computer's switch, or route between the mesh and the robot's own `lan`. A
    computer in another network is cut off.""",
    fix="Give the computer an address in its radios' mesh network, or in the robot's `lan`.",
    failing="robots: {husky1: {computer: {address: 10.99.0.5/24}}}",
    passing="robots: {husky1: {computer: {address: 10.42.0.120/24}}}",
)
def computer_elsewhere(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    wrong = wrong_networks(fleet)
    for robot in fleet.robots.values():
        nodes = [fleet.nodes[name] for name in robot.nodes if name in fleet.nodes]
        if any(mesh in wrong for node in nodes for mesh in node.meshes):
            continue  # MC202 reports the network
        around = dict.fromkeys(mesh.network for node in nodes for mesh in meshes_of(fleet, node))
        if robot.lan is not None:
            around = dict.fromkeys((robot.lan,))
        for place, _, computer in robot.all_computers() if around else ():
            address = computer.address.ip
            if not any(address in network for network in around):
                expected = f"an address in {' or '.join(str(network) for network in around)}"
                path = ("robots", robot.name, *place, "address")
                message = "outside the network of its radios" if robot.lan is None else "outside the robot's LAN"
                yield Finding(path, message, expected, str(address))


@fleet_rule(
    "MC212",
    Severity.WARNING,
    "The log host is unreachable",
    why="The log host is in no network of the fleet, and no node has a gateway: logs are lost.",
    fix="Set `system.log_host` to the base station's computer, or give the nodes a gateway.",
    failing="system: {log_host: 192.0.2.9}",
    passing="system: {log_host: 10.42.0.100}",
)
def log_host_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    host = fleet.system.log_host
    if host and is_host(host) and _out_of_reach(fleet, host):
        yield Finding(("system", "log_host"), "outside the fleet's networks", _within_reach(fleet), host)


@fleet_rule(
    "MC213",
    Severity.WARNING,
    "No time server is reachable",
    why="""Radios have no battery-backed clock. Without a reachable time server, logs start at the image's build date,
    and events on different nodes cannot be correlated.""",
    fix="Run a time server on the base station and list its address.",
    failing="system: {ntp_servers: [0.openwrt.pool.ntp.org]}",
    passing="system: {ntp_servers: [10.42.0.100]}",
)
def time_server_unreachable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    servers = [server for server in fleet.system.ntp_servers if is_host(server)]
    if servers and all(_out_of_reach(fleet, server) for server in servers):
        message = "outside the fleet's networks"
        yield Finding(("system", "ntp_servers"), message, _within_reach(fleet), ", ".join(servers))


def _out_of_reach(fleet: Fleet, host: str) -> bool:
    if wrong_networks(fleet):
        return False
    versions = {node.gateway.version for node in fleet.managed() if node.gateway is not None}
    address = as_address(host)
    if address is None:
        # a name needs a resolver, which also is behind a gateway
        return not versions
    return address.version not in versions and not any(address in network for _, network in networks(fleet))


def _within_reach(fleet: Fleet) -> str:
    """A description of reachable hosts."""
    gateways = {str(node.gateway): node.gateway.version for node in fleet.managed() if node.gateway is not None}
    behind = [f"an IPv{version} address, as gateway {gateway}" for gateway, version in gateways.items()]
    return ", or ".join([*behind[:1], "an address of a mesh's network"])


def is_host(text: str) -> bool:
    """Whether it is an address or can be a host name; MC237 reports what is neither."""
    labels = text.removesuffix(".").split(".")
    is_name = len(text) <= _MAX_HOST_CHARACTERS and all(_LABEL.fullmatch(label) for label in labels)
    # no top-level domain is a number (RFC 3696, 2): 10.42.0 and 10.42.0.300 are mistyped addresses
    return (is_name and not labels[-1].isdecimal()) or as_address(text) is not None


def as_address(host: str) -> IpAddress | None:
    """The IP address that `host` is; None for a name."""
    try:
        return ip_address(host)
    except ValueError:
        return None


@fleet_rule(
    "MC214",
    Severity.ERROR,
    "Two devices have the same SSH host and port",
    why="Each run would configure one device as both in turn; only host key verification prevents it.",
    fix="Remove `ssh.host` to use the device's own address, or give each device its own forwarded port.",
    failing="""
    nodes:
      base: {ssh: {host: 127.0.0.1, port: 2201}}
      b01: {ssh: {host: 127.0.0.1, port: 2201}}
    """,
    passing="""
    nodes:
      base: {ssh: {host: 127.0.0.1, port: 2201}}
      b01: {ssh: {host: 127.0.0.1, port: 2202}}
    """,
)
def ssh_endpoint_twice(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # devices behind different jump hosts may share a host and port
    for (host, port, _), devices in duplicates(_endpoints(fleet)):
        owner = next((device for device in devices if not device[2]), devices[0])
        for path, _, is_written in devices:
            if is_written and path != owner[0]:
                message = f"{owner[1]} has the same host and port"
                yield Finding(path, message, "a unique host and port", host_and_port(host, port))


def _endpoints(fleet: Fleet) -> Iterator[tuple[tuple[str, int, str], tuple[tuple[str, ...], str, bool]]]:
    """Where each device accepts logins: the path of its `ssh.host`, what it is, and whether it has one."""
    for node in fleet.managed():
        ssh = node.ssh
        own = ("nodes", node.name, "ssh", "host")
        yield (ssh.host or str(node.address.ip), ssh.port, ssh.jump), (own, node.name, bool(ssh.host))
    for robot in fleet.robots.values():
        for key, what, computer in robot.all_computers():
            ssh = computer.ssh
            path = ("robots", robot.name, *key, "ssh", "host")
            yield (ssh.host or str(computer.address.ip), ssh.port, ssh.jump), (path, what, bool(ssh.host))
