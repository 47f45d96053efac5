"""Firewall zones of extra_uci: those that take over the management network, and open uplinks (MC929 to MC930)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import created_sections, with_parts
from meshctl.model import Fleet
from meshctl.uci import Package, Section

# of netifd and its packages; tunnels such as wireguard are not among them, since both ends may be the team's
_UPLINK_PROTOCOLS = ("dhcp", "dhcpv6", "pppoe", "pppoa", "pptp", "3g", "qmi", "mbim", "ncm", "modemmanager", "dslite")
_UPLINK = """
    nodes: {b01: {extra_uci: {network.wan: interface, network.wan.proto: dhcp, network.wan.device: eth1,
      firewall.wan: zone, firewall.wan.name: wan, firewall.wan.network: wan, firewall.wan.input: REJECT,
      firewall.wan.masq: '1'}}}
    """


@fleet_rule(
    "MC929",
    Severity.ERROR,
    "A firewall zone of extra_uci contains the management network",
    why="""A zone is a set of interfaces. One with the name of the zone `management`, with its network `lan`, or with an
    interface on the same bridge applies to what arrives from the mesh: it rejects logins or translates addresses, and
    which of the two zones decides depends on their order.""",
    fix="""Give the zone a name and a network of its own, whose interface has a device that is not in br-lan. To change
    the zone of the mesh, set options of `firewall.management`.""",
    failing=_UPLINK.replace("firewall.wan.network: wan", "firewall.wan.network: lan"),
    passing=_UPLINK,
    is_per_kind=True,
)
def zone_taken(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_parts(fleet, context):
        firewall = packages.get("firewall")
        created = dict(created_sections(node, packages, "firewall"))
        own = [] if firewall is None else [zone for zone in firewall.of_type("zone") if zone.name not in created]
        for name, zone in created.items():
            if zone.type == "zone":
                for keys, message, expected, found in _shared(name, zone, own, packages):
                    key = next((key for key in keys if key in node.extra_uci), f"firewall.{name}")
                    yield Finding(("nodes", node.name, "extra_uci", key), message, expected, found)


@fleet_rule(
    "MC930",
    Severity.WARNING,
    "The firewall is open toward an uplink",
    why="""What is beyond an uplink is not the team's: the internet, a provider's or a client's network. With
    `input: ACCEPT`, or without a policy where the default is that, everyone there reaches the node's SSH, name and web
    servers, as they do by a rule without `dest_port`; a forwarding from its zone leads to all radios and robots.""",
    fix="""Set `input: REJECT` for the uplink's zone, remove the forwarding, and open single ports with a `rule`.
    Answers to the node's own connections pass in any case. If the uplink is a trusted network, suppress this finding
    with that reason.""",
    failing=_UPLINK.replace("REJECT", "ACCEPT"),
    passing=_UPLINK,
    is_per_kind=True,
)
def uplink_open(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_parts(fleet, context):
        uplinks = {name for name, section in created_sections(node, packages, "network") if _is_uplink(section)}
        firewall = packages.get("firewall")
        if firewall is None or not uplinks:
            continue
        default = next((section.get("input") for section in firewall.of_type("defaults")), "")
        outer = set()
        for zone in firewall.of_type("zone"):
            inside = [name for name in zone.get("network").split() if name in uplinks]
            outer |= {zone.get("name")} if inside else set()
            policy = zone.get("input") or default
            if inside and policy == "ACCEPT":
                own = f"firewall.{zone.name}"
                keys = (f"{own}.input", f"{own}.network", own)
                key = next((key for key in keys if key in node.extra_uci), f"network.{inside[0]}")
                message = f"everyone beyond {', '.join(inside)} reaches this node's servers"
                yield Finding(("nodes", node.name, "extra_uci", key), message, "input REJECT", f"input {policy}")
        for name, section in created_sections(node, packages, "firewall"):
            source, dest = section.get("src"), section.get("dest")
            if source not in outer or dest in outer or not _lets_all_in(section):
                continue
            key = f"firewall.{name}.src" if f"firewall.{name}.src" in node.extra_uci else f"firewall.{name}"
            reached = f"what is in {dest}" if dest else "this node's servers"
            expected = (
                f"src {dest}, dest {source}" if section.type == "forwarding" else "a rule with dest_port or src_ip"
            )
            message = f"everyone beyond {source} reaches {reached}"
            yield Finding(("nodes", node.name, "extra_uci", key), message, expected, f"src {source}")


def _lets_all_in(section: Section) -> bool:
    """Whether it is a forwarding, or a rule that accepts connections from anywhere to any port."""
    if section.type == "forwarding":
        return bool(section.get("dest"))
    is_narrow = any(section.get(option) for option in ("dest_port", "src_port", "src_ip", "src_mac", "ipset", "mark"))
    protocols = set(section.get("proto").lower().split())
    reaches_servers = not protocols or bool(protocols & {"all", "any", "*", "tcp", "tcpudp", "udp"})
    is_accepting = section.type == "rule" and section.get("target") == "ACCEPT"
    return is_accepting and reaches_servers and not is_narrow and section.get("enabled") != "0"


def _is_uplink(interface: Section) -> bool:
    """Whether another network gives the interface its address, or it leads to a gateway."""
    if interface.type != "interface":
        return False
    proto = interface.get("proto")
    return proto in _UPLINK_PROTOCOLS or (proto == "static" and bool(interface.get("gateway")))


def _shared(
    name: str, zone: Section, others: list[Section], packages: Mapping[str, Package]
) -> Iterator[tuple[tuple[str, ...], str, str, str]]:
    """What a zone has in common with those that meshctl renders: keys of `extra_uci` that may say so, a message, what
    is expected and found."""
    own = f"firewall.{name}"
    bridges = dict(_devices(packages, (word for other in others for word in other.get("network").split())))
    for other in others:
        if zone.get("name") and zone.get("name") == other.get("name"):
            yield (f"{own}.name",), "the zone of the mesh has this name", "a name of its own", zone.get("name")
        for network in zone.get("network").split():
            if network in other.get("network").split():
                yield (f"{own}.network",), f"{network} is in zone {other.get('name')}", "a network of its own", network
    for network, device in _devices(packages, zone.get("network").split()):
        if network not in bridges and device in bridges.values():
            keys = (f"network.{network}.device", f"network.{network}.ifname", f"{own}.network")
            yield (
                keys,
                f"{network} would be in zone {zone.get('name')} and in that of the mesh",
                "another device",
                device,
            )


def _devices(packages: Mapping[str, Package], networks: Iterator[str] | list[str]) -> Iterator[tuple[str, str]]:
    """The networks' interfaces, each with its device."""
    package = packages.get("network")
    for network in networks:
        section = None if package is None else package.section(network)
        if section is not None:
            is_bridge = section.get("type") == "bridge"
            device = f"br-{network}" if is_bridge else section.get("device") or section.get("ifname")
            if device.startswith("@"):
                yield from ((network, alias) for _, alias in _devices(packages, [device[1:]]))
            elif device:
                yield network, device
