"""The addresses that a DHCP server of extra_uci gives out (MC926 to MC928)."""

from __future__ import annotations

from collections.abc import Iterator
from ipaddress import IPv4Address, IPv4Interface, ip_interface
from typing import NamedTuple

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import duplicates
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.extra_networks import address_ranges, missing_for_server
from meshctl.lint.rules.rendering import with_extra
from meshctl.lint.trial_rendering import kind_of
from meshctl.model import Fleet, Node
from meshctl.resolve.intent import LAN
from meshctl.uci import Package, Section
from meshctl.wording import join_limited

# defaults of dnsmasq's service
_START, _LIMIT = "100", "150"
_SERVING = """
    nodes: {base: {extra_uci: {dhcp.lan.ignore: '0', dhcp.lan.start: 'START', dhcp.lan.limit: '50',
      dhcp.lan.dhcpv4: server, dhcp.dns: dnsmasq, dhcp.dns.authoritative: '1'}}}
    """
_GATEWAYS = """
    groups: {serving: {extra_uci: {network.bat0.gw_mode: server, dhcp.lan.ignore: '0', dhcp.lan.dhcpv4: server,
      dhcp.lan.limit: '20', dhcp.dns: dnsmasq, dhcp.dns.authoritative: '1'}}}
    nodes: {base: {groups: [serving], extra_uci: {dhcp.lan.start: '120'}},
      b01: {groups: [serving], extra_uci: {dhcp.lan.start: 'START'}}}
    """


class _Range(NamedTuple):
    """The addresses that a node serves on one of its networks, and the key of `extra_uci` that says so."""

    node: Node
    key: str
    interface: str
    owner: IPv4Interface
    start: int
    limit: int

    @property
    def first(self) -> IPv4Address:
        return self.owner.network[max(self.start, 1)]

    @property
    def last(self) -> IPv4Address:
        return self.owner.network[min(max(self.start, 1) + self.limit - 1, self.owner.network.num_addresses - 2)]

    def __str__(self) -> str:
        return f"{self.first} to {self.last}"


@fleet_rule(
    "MC926",
    Severity.ERROR,
    "A DHCP range contains the address of a station",
    why="""The server gives such an address to a client as soon as the station is off or out of reach for a moment. Then
    two devices have one address: the node, or the robot's computer, is not reachable until the client has left.""",
    fix="""Choose a `start` behind the last station: it counts from the network's address, and `limit` addresses follow.
    Without them it is 100 and 150.""",
    failing=_SERVING.replace("START", "90"),
    passing=_SERVING.replace("START", "120"),
)
def range_with_stations(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    stations = dict(_stations(fleet))
    for served in _shared_ranges(fleet, context):
        inside = [
            f"{name} ({address})"
            for address, name in sorted(stations.items())
            if served.first <= address <= served.last and address != served.owner.ip
        ]
        if inside:
            path = ("nodes", served.node.name, "extra_uci", served.key)
            expected = "a range without stations"
            yield Finding(path, f"contains {join_limited(inside)}", expected, str(served))


@fleet_rule(
    "MC927",
    Severity.WARNING,
    "Two nodes give out the same addresses",
    why="""The servers do not know of each other's leases: two clients get one address. It happens when gateways share
    `start` and `limit` through their group.""",
    fix="Give each node a `dhcp.lan.start` of its own, so that the ranges do not overlap.",
    failing=_GATEWAYS.replace("START", "130"),
    passing=_GATEWAYS.replace("START", "140"),
)
def ranges_overlap(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    # MC913 reports servers that are no gateways of batman-adv
    of_network = duplicates(
        (served.owner.network, served)
        for served in _shared_ranges(fleet, context)
        if served.node.extra_uci.get("network.bat0.gw_mode") == "server"
    )
    for _, sharing in of_network:
        ordered = sorted(sharing, key=lambda served: (served.first, served.node.name))
        widest = ordered[0]
        for served in ordered[1:]:
            if served.first <= widest.last and served.node.name != widest.node.name:
                path = ("nodes", served.node.name, "extra_uci", served.key)
                yield Finding(path, f"overlaps that of {widest.node.name}", "a range of its own", str(served))
            widest = max(widest, served, key=lambda other: other.last)


@fleet_rule(
    "MC928",
    Severity.ERROR,
    "A DHCP range is outside its network",
    why="""`start` counts from the network's address. OpenWrt takes the remainder of one that is larger than the
    network: 300 in a /24 begins at .44, among the nodes.""",
    fix="Choose a smaller `start`, or a larger network.",
    failing=_SERVING.replace("START", "300"),
    passing=_SERVING.replace("START", "120"),
    is_per_kind=True,
)
def range_outside(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for served in _ranges(fleet, context):
        network = served.owner.network
        if served.start >= network.num_addresses - 1:
            path = ("nodes", served.node.name, "extra_uci", served.key)
            yield Finding(path, f"not in {network}", f"1 to {network.num_addresses - 2}", str(served.start))


def _shared_ranges(fleet: Fleet, context: LintContext) -> Iterator[_Range]:
    """The ranges in networks of meshes, of every node; the trial renders one node of each kind."""
    for served in _ranges(fleet, context):
        if served.interface != LAN or served.node.lan_address is not None:
            continue
        for node in fleet.managed():
            if kind_of(node) == kind_of(served.node) and isinstance(node.address, IPv4Interface):
                own = served._replace(node=node, owner=node.address)
                if own.start < own.owner.network.num_addresses - 1:
                    yield own


def _ranges(fleet: Fleet, context: LintContext) -> Iterator[_Range]:
    for node, packages in with_extra(fleet, context):
        dhcp, network = packages.get("dhcp"), packages.get("network")
        for _, section in address_ranges(node, dhcp):
            owner = None if network is None else _owner(network, section)
            start, limit = section.get("start") or _START, section.get("limit") or _LIMIT
            # MC914 reports a range that is not served, MC918 what is no number
            if owner is None or dhcp is None or missing_for_server(dhcp, section):
                continue
            if not (start.isdecimal() and limit.isdecimal()):
                continue
            keys = [f"dhcp.{section.name}.{option}" for option in ("start", "limit", "ignore", "dhcpv4")]
            key = next((key for key in keys if key in node.extra_uci), f"dhcp.{section.name}")
            yield _Range(node, key, section.get("interface"), owner, int(start), int(limit))


def _owner(network: Package, served: Section) -> IPv4Interface | None:
    """The address of the interface that a DHCP section serves, with its netmask."""
    interface = network.section(served.get("interface")) if served.get("interface") else None
    if interface is None or interface.get("proto") != "static" or not interface.get("ipaddr"):
        return None
    address, netmask = interface.get("ipaddr").split()[0], interface.get("netmask")
    if "/" not in address and not netmask:
        return None  # MC924 reports it
    try:
        owner = ip_interface(address if "/" in address else f"{address}/{netmask}")
    except ValueError:
        return None
    return owner if isinstance(owner, IPv4Interface) else None


def _stations(fleet: Fleet) -> Iterator[tuple[IPv4Address, str]]:
    for node in fleet.managed():
        if isinstance(node.address.ip, IPv4Address):
            yield node.address.ip, node.name
    for robot in fleet.robots.values():
        for _, _, computer in robot.all_computers():
            if isinstance(computer.address.ip, IPv4Address):
                yield computer.address.ip, f"the computer of {robot.name}"
