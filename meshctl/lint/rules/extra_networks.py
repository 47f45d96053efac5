"""Rules about interfaces and access points that extra_uci attaches to a node's networks (MC914 to MC917)."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import ip_interface

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import created_sections, with_extra
from meshctl.model import Fleet, Node
from meshctl.model.ip import IpNetwork
from meshctl.resolve.intent import LAN
from meshctl.uci import Package, Section

# values that libuci's users read as true
_TRUE = ("1", "on", "true", "yes", "enabled")


def is_on(section: Section, option: str) -> bool:
    return section.get(option).lower() in _TRUE


@fleet_rule(
    "MC914",
    Severity.ERROR,
    "A DHCP server of extra_uci does not start",
    why="""meshctl turns the address server off: /etc/config/dhcp has no section of the type `dnsmasq`, so dnsmasq does
    not start, and the network `lan` has `dhcpv4: disabled`. A range of addresses alone is not served: clients of the
    access point connect and get no address.""",
    fix="""Add a section of the type `dnsmasq` (`dhcp.dns: dnsmasq` and `dhcp.dns.authoritative: "1"`), and for `lan`
    also `dhcp.lan.dhcpv4: server`.""",
    failing="nodes: {base: {extra_uci: {dhcp.lan.ignore: '0', dhcp.lan.start: '120', dhcp.lan.dhcpv4: server}}}",
    passing="""
    nodes: {base: {extra_uci: {dhcp.lan.ignore: '0', dhcp.lan.start: '120', dhcp.lan.dhcpv4: server,
      dhcp.dns: dnsmasq, dhcp.dns.authoritative: '1'}}}
    """,
    is_per_kind=True,
)
def address_server_off(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        dhcp = packages.get("dhcp")
        for key, section in address_ranges(node, dhcp):
            missing = [] if dhcp is None else missing_for_server(dhcp, section)
            if missing:
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, "no address is served", " and ".join(missing), "none")


def missing_for_server(dhcp: Package, section: Section) -> list[str]:
    """The options that are missing before a range of addresses is served."""
    missing = []
    if is_on(section, "ignore"):
        missing.append(f'dhcp.{section.name}.ignore: ""')
    if not _has_server(dhcp, section):
        missing.append("a section of the type dnsmasq")
    if section.get("dhcpv4") == "disabled":
        missing.append(f"dhcp.{section.name}.dhcpv4: server")
    return missing


def address_ranges(node: Node, dhcp: Package | None) -> Iterator[tuple[str, Section]]:
    """The networks that `extra_uci` has IPv4 addresses served in, each with a key of `extra_uci` that says so."""
    for section in () if dhcp is None else dhcp.of_type("dhcp"):
        keys = [f"dhcp.{section.name}", *(f"dhcp.{section.name}.{option}" for option in ("ignore", "start", "limit"))]
        given = [key for key in keys if key in node.extra_uci]
        # turned off on purpose, or by meshctl while the inventory sets up a range
        is_ignored = is_on(section, "ignore") and (
            f"dhcp.{section.name}.ignore" in node.extra_uci or not _is_range(section)
        )
        is_ipv6_only = any(section.get(option) == "server" for option in ("ra", "dhcpv6")) and not _is_range(section)
        if given and not is_ignored and not is_ipv6_only:
            yield given[0], section


def _is_range(section: Section) -> bool:
    return bool(section.get("start") or section.get("limit") or section.get("dhcpv4") == "server")


def _has_server(dhcp: Package, served: Section) -> bool:
    if any(not is_on(section, "disabled") for section in dhcp.of_type("dnsmasq")):
        return True
    is_main = any(is_on(section, "maindhcp") for section in dhcp.of_type("odhcpd"))
    return is_main and served.get("dhcpv4") == "server"


@fleet_rule(
    "MC915",
    Severity.ERROR,
    "An interface of extra_uci overlaps a network of the fleet",
    why="""The node then has two routes to the same addresses and sends answers out of the wrong interface: it is not
    reachable from the mesh, or a robot's LAN is not reachable from it.""",
    fix="Give the interface a network that is neither a mesh's nor a robot's LAN.",
    failing="""
    nodes: {b01: {extra_uci: {network.camera: interface, network.camera.device: eth1, network.camera.proto: static,
      network.camera.ipaddr: 10.42.0.200, network.camera.netmask: 255.255.255.128}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {network.camera: interface, network.camera.device: eth1, network.camera.proto: static,
      network.camera.ipaddr: 172.20.0.1, network.camera.netmask: 255.255.255.0}}}
    """,
    is_per_kind=True,
)
def interface_overlaps(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        network = packages.get("network")
        created = dict(created_sections(node, packages, "network"))
        others = [] if network is None else list(_networks_of_the_fleet(network, created))
        for name, section in created.items():
            for option, found in _networks(section) if section.type == "interface" else ():
                for owner, device, known in others:
                    if known.overlaps(found) and section.get("device") not in (device, f"@{owner}"):
                        path = ("nodes", node.name, "extra_uci", f"network.{name}.{option}")
                        yield Finding(path, f"overlaps {known} of {owner}", "a separate network", str(found))
                        break


def _networks_of_the_fleet(network: Package, created: dict[str, Section]) -> Iterator[tuple[str, str, IpNetwork]]:
    """Owner, device and network of every address and route that the inventory's own keys give."""
    for section in network.of_type("interface"):
        if section.name is not None and section.name not in created:
            is_bridge = section.get("type") == "bridge"
            device = f"br-{section.name}" if is_bridge else section.get("device") or section.get("ifname")
            yield from ((section.name, device, found) for _, found in _networks(section))
    for route in (*network.of_type("route"), *network.of_type("route6")):
        if route.name is None or route.name not in created:
            found = _network(route.get("target"), route.get("netmask"))
            if found is not None:
                yield "a robot's LAN", "", found


def _networks(section: Section) -> Iterator[tuple[str, IpNetwork]]:
    """The networks of an interface's static addresses, each with the option that has it."""
    if section.get("proto") == "static":
        for option, netmask in (("ipaddr", section.get("netmask")), ("ip6addr", "")):
            for word in section.get(option).split():
                found = _network(word, netmask)
                if found is not None:
                    yield option, found


def _network(address: str, netmask: str) -> IpNetwork | None:
    try:
        return ip_interface(address if "/" in address or not netmask else f"{address}/{netmask}").network
    except ValueError:
        return None


@fleet_rule(
    "MC916",
    Severity.ERROR,
    "A wireless interface of extra_uci cannot be part of its network",
    why="""The kernel accepts a client interface (`mode: sta`) as a port of a bridge only with 4-address frames. The
    networks `mesh0`, `mesh1`, ... and `bat0` are the mesh's own: another interface there takes the place of the mesh
    radio, and the node leaves the mesh.""",
    fix="""Attach it to `lan`, or to a network of its own. A client interface in a bridge needs `wds: "1"`, here and at
    the access point that it joins.""",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.encryption: owe, wireless.guest.network: mesh0}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.uplink: wifi-iface, wireless.uplink.device: radio0, wireless.uplink.mode: sta,
      wireless.uplink.ssid: hq, wireless.uplink.wds: '1', wireless.uplink.network: lan}}}
    """,
    is_per_kind=True,
)
def interface_not_attachable(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        network = packages.get("network")
        for name, interface in created_sections(node, packages, "wireless"):
            path = ("nodes", node.name, "extra_uci", f"wireless.{name}.network")
            is_client = interface.get("mode") == "sta" and not is_on(interface, "wds")
            for attached in interface.get("network").split() if interface.type == "wifi-iface" else ():
                section = None if network is None else network.section(attached)
                if attached in node.mesh_interfaces or (
                    section is not None and section.get("proto").startswith("batadv")
                ):
                    yield Finding(path, "this network is the mesh's own", "lan, or a network of its own", attached)
                elif network is not None and section is not None and is_client and _is_bridge(network, section):
                    expected = f'wireless.{name}.wds: "1", or a network without a bridge'
                    yield Finding(path, "a client interface cannot be a port of a bridge", expected, attached)


def _is_bridge(network: Package, interface: Section) -> bool:
    bridges = {device.get("name") for device in network.of_type("device") if device.get("type") == "bridge"}
    return interface.get("type") == "bridge" or interface.get("device") in bridges


@fleet_rule(
    "MC917",
    Severity.WARNING,
    "An open access point leads to the robots",
    why="""Anyone in range can join it, and is then in one network with the robots' computers and the radios. Phones
    join by themselves and load the mesh, and an attacker needs no key. `owe` encrypts, but admits everyone, too.""",
    fix="""Give the access point a network and a firewall zone of its own, or add it with a passphrase in a template of
    your own.""",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.encryption: none, wireless.guest.network: lan}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.encryption: none, wireless.guest.network: visitors,
      network.visitors: interface, network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def access_point_open(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in created_sections(node, packages, "wireless"):
            is_open = interface.get("encryption", "none").startswith(("none", "owe"))
            is_access_point = interface.type == "wifi-iface" and interface.get("mode") == "ap"
            if is_open and is_access_point and LAN in interface.get("network").split() and _reaches_robots(fleet, node):
                given = (f"wireless.{name}.encryption", f"wireless.{name}")
                key = next(key for key in given if key in node.extra_uci)
                found = interface.get("encryption") or "none"
                expected = "a network of its own, or a passphrase"
                yield Finding(("nodes", node.name, "extra_uci", key), "anyone in range can join", expected, found)


def _reaches_robots(fleet: Fleet, node: Node) -> bool:
    """Whether its bridge is a robot's LAN, or a network with robots' computers."""
    networks = [fleet.meshes[name].network for name in node.meshes if name in fleet.meshes]
    return node.lan_address is not None or any(
        computer.address.ip in network
        for robot in fleet.robots.values()
        for _, _, computer in robot.all_computers()
        for network in networks
    )
