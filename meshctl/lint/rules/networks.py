"""Networks: overlaps, public and unusable ranges, room, prefixes, the base station's (MC205 to MC222)."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import ip_network

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key, overlaps
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.addresses import meshes_of, networks, overlapping_meshes, stations, wrong_networks
from meshctl.lint.rules.team import reached_from_base
from meshctl.model import Backend, Fleet, Mesh, Role
from meshctl.model.ip import IpAddress, IpInterface, IpNetwork
from meshctl.wording import join_limited

# RFC 1918, RFC 6598 (carrier-grade NAT), and RFC 4193 (unique local IPv6)
_PRIVATE = tuple(
    ip_network(text) for text in ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "100.64.0.0/10", "fc00::/7")
)


# 0/8, loopback, link-local, multicast, reserved; in IPv6 loopback and mapped IPv4, link-local, multicast
_UNUSABLE = tuple(
    ip_network(text)
    for text in ("0.0.0.0/8", "127.0.0.0/8", "169.254.0.0/16", "224.0.0.0/3", "::/32", "fe80::/10", "ff00::/8")
)


# so many computers of a network, all with another prefix length: the network's is wrong
_WRONG_PREFIXES = 3


@fleet_rule(
    "MC205",
    Severity.ERROR,
    "The networks of two meshes overlap",
    why="""A node in both meshes, or a robot that bridges both, has two routes to one address and uses the wrong one
    half the time.""",
    fix="""Use separate networks; or the same network for both, if one routing interface can carry both cells: same back
    end, same `routing_algo`, or with operator parts the same `interface`.""",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.128/25,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second}}}}
    robots: {base-station: {computer: {links: [{address: 10.42.0.130}]}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second}}}}
    robots: {base-station: {computer: {links: [{address: 10.43.0.100}]}}}
    """,
)
def networks_overlap(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for (mesh, network), (other, of_other) in overlaps((mesh, mesh.network) for mesh in fleet.meshes.values()):
        difference = _routing_difference(mesh, other)
        if mesh.network != other.network:
            message = f"overlaps {of_other} of mesh {other.name}"
            yield Finding(("meshes", mesh.name, "network"), message, "a separate network", str(network))
        elif difference:
            message = f"mesh {other.name} has the same network, but no routing interface can carry both: {difference}"
            yield Finding(("meshes", mesh.name, "network"), message, "a separate network", str(network))


def _routing_difference(mesh: Mesh, other: Mesh) -> str:
    """Why two cells cannot share a routing interface, as cells of one network do (one per band); empty if they can."""
    if mesh.backend is not other.backend:
        return f"{other.name} has back end {other.backend.value}, {mesh.name} {mesh.backend.value}"
    if mesh.backend is Backend.BATMAN:
        option, own, theirs = "routing_algo", mesh.batman.routing_algo, other.batman.routing_algo
    else:
        option, own, theirs = "interface", mesh.operator_parts.interface, other.operator_parts.interface
    return "" if own == theirs else f"{other.name} has {option} {theirs}, {mesh.name} {own}"


@fleet_rule(
    "MC207",
    Severity.WARNING,
    "The network is not private",
    why="""Internet hosts with these addresses become unreachable from every robot and laptop, and replies leak through
    the uplink.""",
    fix="Use an RFC 1918 network, such as 10.42.0.0/24, or a unique local IPv6 network, such as fd42::/64.",
    failing="""
    meshes: {main: {network: 11.42.0.0/24}}
    nodes: {base: {address: 11.42.0.1}, husky1-front: {address: 11.42.0.11}, b01: {address: 11.42.0.101}}
    robots: {base-station: {computer: {address: 11.42.0.100/24}}, husky1: {computer: {address: 11.42.0.110/24}}}
    """,
    passing="meshes: {main: {network: 10.42.0.0/24}}",
)
def network_public(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for path, network in networks(fleet):
        if not any(_is_within(network, private) for private in _PRIVATE) and not _unusable(network):
            yield Finding(path, "not a private network", "an RFC 1918 network, or one of fd00::/8", str(network))


@fleet_rule(
    "MC208",
    Severity.ERROR,
    "The network is not usable for stations",
    why="Loopback, link-local, multicast and reserved ranges are not routed or not accepted on an interface.",
    fix="Use an RFC 1918 network, such as 10.42.0.0/24, or a unique local IPv6 network, such as fd42::/64.",
    failing="""
    meshes: {main: {network: 127.42.0.0/24}}
    nodes: {base: {address: 127.42.0.1}, husky1-front: {address: 127.42.0.11}, b01: {address: 127.42.0.101}}
    robots: {base-station: {computer: {address: 127.42.0.100/24}}, husky1: {computer: {address: 127.42.0.110/24}}}
    """,
    passing="meshes: {main: {network: 10.42.0.0/24}}",
)
def network_unusable(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    for path, network in networks(fleet):
        if _unusable(network):
            yield Finding(path, "reserved address range", "an RFC 1918 network, or one of fd00::/8", str(network))


def _is_within(network: IpNetwork, other: IpNetwork) -> bool:
    """Whether `other` contains the whole of `network`."""
    return network.network_address in other and network.prefixlen >= other.prefixlen


def _unusable(network: IpNetwork) -> bool:
    return any(network.overlaps(unusable) for unusable in _UNUSABLE)


@fleet_rule(
    "MC210",
    Severity.ERROR,
    "A computer's prefix length differs from its network's",
    why="""With a longer prefix the computer sends part of the fleet's traffic to a gateway that does not exist; with a
    shorter one it expects remote stations on its own link.""",
    fix="Use the prefix length of the mesh's network, or of the robot's `lan`.",
    failing="robots: {husky1: {computer: {address: 10.42.0.120/28}}}",
    passing="robots: {husky1: {computer: {address: 10.42.0.120/24}}}",
)
def prefix_differs(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    there: dict[tuple[str, str, IpNetwork], list[tuple[tuple[str, ...], str, IpInterface]]] = {}
    for robot in fleet.robots.values():
        around = [("the robot's LAN", "the LAN's", robot.lan)] if robot.lan is not None else []
        if not around:
            # meshes may share a network
            first_of = {mesh.network: mesh.name for mesh in reversed(tuple(fleet.meshes.values()))}
            around = [(f"mesh {name}", "the mesh's", network) for network, name in first_of.items()]
        for place, name, computer in robot.all_computers():
            for where, whose, network in around:
                if computer.address.ip in network:
                    path = ("robots", robot.name, *place, "address")
                    there.setdefault((where, whose, network), []).append((path, name, computer.address))
    for (where, whose, network), computers in there.items():
        wrong = [one for one in computers if one[2].network != network]
        lengths = {address.network.prefixlen for _, _, address in wrong}
        name = where.removeprefix("mesh ")
        if (
            len(wrong) >= _WRONG_PREFIXES
            and len(wrong) == len(computers)
            and len(lengths) == 1
            and name in fleet.meshes
        ):
            # one mistake in the network, rather than one in each address
            message = f"its length differs from that of {join_limited([what for _, what, _ in wrong])}"
            yield Finding(("meshes", name, "network"), message, f"/{lengths.pop()}", f"/{network.prefixlen}")
            continue
        for path, _, address in wrong:
            expected = f"/{network.prefixlen} as in {where}"
            yield Finding(path, f"prefix length differs from {whose}", expected, f"/{address.network.prefixlen}")


@fleet_rule(
    "MC211",
    Severity.WARNING,
    "The network has no free addresses for a replacement",
    why="""When all addresses are used, a spare cannot join next to the node it replaces, and a laptop cannot join for
    diagnosis.""",
    fix="Use a larger network; a shorter prefix costs nothing.",
    failing="""
    meshes: {main: {network: 10.42.0.0/29}}
    nodes: {base: {address: 10.42.0.1}, husky1-front: {address: 10.42.0.2}, b01: {address: 10.42.0.3}}
    robots: {base-station: {computer: {address: 10.42.0.4/29}}, husky1: {computer: {address: 10.42.0.5/29}}}
    """,
    passing="""
    meshes: {main: {network: 10.42.0.0/28}}
    nodes: {base: {address: 10.42.0.1}, husky1-front: {address: 10.42.0.2}, b01: {address: 10.42.0.3}}
    robots: {base-station: {computer: {address: 10.42.0.4/28}}, husky1: {computer: {address: 10.42.0.5/28}}}
    """,
)
def network_full(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    # a spare and the operator's laptop
    reserve = 2
    taken: dict[str, set[IpAddress]] = {name: set() for name in fleet.meshes}
    by_network = group_by_key((mesh.network, name) for name, mesh in fleet.meshes.items())
    # one lookup per prefix length instead of one per network
    lengths = {(network.version, network.prefixlen) for network in by_network}
    for address, _ in stations(fleet):
        for version, length in lengths:
            if version != address.version:
                continue
            for name in by_network.get(ip_network((address, length), strict=False), ()):
                taken[name].add(address)
    for name, mesh in fleet.meshes.items():
        room = mesh.network.num_addresses - 2 - len(taken[name])
        if len(taken[name]) > 0 and room < reserve:
            path = ("meshes", name, "network")
            yield Finding(
                path,
                f"{len(taken[name])} of {mesh.network.num_addresses - 2} in use",
                f"at least {reserve} free addresses",
                f"{max(room, 0)}",
            )


@fleet_rule(
    "MC215",
    Severity.ERROR,
    "A node's prefix length differs from its mesh's",
    why="""With a longer prefix the node sends part of the mesh's traffic to a gateway that does not exist; with a
    shorter one it expects remote stations on its own link. Some nodes can reach it, others cannot.""",
    fix="Omit the prefix length: it defaults to that of the mesh's network.",
    failing="nodes: {b01: {address: 10.42.0.7/16}}",
    passing="nodes: {b01: {address: 10.42.0.7}}",
)
def node_prefix_differs(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    unclear = overlapping_meshes(fleet)
    for node in fleet.managed():
        holding = [mesh for mesh in meshes_of(fleet, node) if node.address.ip in mesh.network]
        if unclear.intersection(node.meshes):
            continue
        if holding and not any(node.address.network == mesh.network for mesh in holding):
            expected = f"/{holding[0].network.prefixlen} as in mesh {holding[0].name}"
            path = ("nodes", node.name, "address")
            yield Finding(path, "prefix length differs from the mesh's", expected, f"/{node.address.network.prefixlen}")


@fleet_rule(
    "MC221",
    Severity.WARNING,
    "The base station has no address in a mesh's network",
    why="""Radios route nothing between the networks of two meshes: a robot with a radio in each joins them to one
    Ethernet segment that carries both networks. A base station without an address in such a network reaches none of its
    radios: `provision` and `status` report them as unreachable, although the mesh works.""",
    fix="""Give the base station's computer a second address, in that network, and list it under its `links`; or give
    these radios a `gateway`, `ssh.jump` or `ssh.host`.""",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      husky1-front: {radios: {radio1: {mesh: second}}}
      b01: {address: 10.43.0.101, radios: {radio0: {mesh: null}, radio1: {mesh: second}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.43.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes:
      husky1-front: {radios: {radio1: {mesh: second}}}
      b01: {address: 10.43.0.101, radios: {radio0: {mesh: null}, radio1: {mesh: second}}}
    robots: {base-station: {computer: {links: [{address: 10.43.0.100}]}}}
    """,
)
def base_in_other_network(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    bases = [robot for robot in fleet.robots.values() if robot.is_base and robot.computer is not None]
    own = {name for robot in bases for name in robot.nodes}
    known = [node.address.ip for node in fleet.managed() if node.role is Role.BASE or node.name in own]
    for robot in bases:
        for _, _, computer in robot.all_computers():
            if any(link.address is None for link in computer.links):
                # a link by the name of its interface has an address that the inventory does not know
                return
            known += [computer.address.ip, *(link.address for link in computer.links if link.address is not None)]
    if not bases:
        return
    # MC601 reports the other meshes, MC202 a wrong network
    reached = reached_from_base(fleet) - wrong_networks(fleet)
    others = {
        mesh.name
        for mesh in fleet.meshes.values()
        if mesh.name in reached and not any(address in mesh.network for address in known)
    }
    cut_off = (
        (mesh.name, node.name)
        for node in fleet.managed()
        if node.gateway is None and not node.site and not node.ssh.host and not node.ssh.jump
        for mesh in meshes_of(fleet, node)
        if mesh.name in others and node.address.ip in mesh.network
    )
    for name, nodes in group_by_key(cut_off).items():
        network = fleet.meshes[name].network
        message = f"only an address in it reaches {join_limited(nodes)}"
        expected = f"a base station's computer in {network}"
        yield Finding(("meshes", name, "network"), message, expected, join_limited(sorted(map(str, known))))


@fleet_rule(
    "MC222",
    Severity.WARNING,
    "No station has an address in a mesh's network",
    why="""The network is another's, or none: it is a typing error, or left from an earlier one. Checks of overlaps and
    addresses use it, and nodes whose addresses are added later get a prefix that fits nothing.""",
    fix="Give the mesh the network of its members' addresses, which meshes under one routing interface may share.",
    failing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.77.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second}}}, b01: {radios: {radio1: {mesh: second}}}}
    """,
    passing="""
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {base: {radios: {radio1: {mesh: second}}}, b01: {radios: {radio1: {mesh: second}}}}
    """,
)
def network_without_station(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    taken = [(address, path[1]) for address, (path, _) in stations(fleet)]
    for mesh in fleet.meshes.values():
        members = [node for node in fleet.members(mesh.name) if node.state.is_managed]
        # another site's nodes may have addresses in it
        sites = {node.site for node in members}
        bases = {node.robot for node in fleet.managed() if node.role is Role.BASE and node.site in sites}
        own = bases.union(*((node.name, node.robot) for node in members))
        # where no mesh of a node has its address, MC202 reports the node, or this network
        if (
            members
            and all(any(node.address.ip in own_mesh.network for own_mesh in meshes_of(fleet, node)) for node in members)
            and not any(address in mesh.network for address, who in taken if who in own)
        ):
            others = {str(other.network) for node in members for other in meshes_of(fleet, node) if other is not mesh}
            names = join_limited([node.name for node in members])
            message = f"contains no address of {names}, nor of a computer"
            yield Finding(("meshes", mesh.name, "network"), message, join_limited(sorted(others)), str(mesh.network))
