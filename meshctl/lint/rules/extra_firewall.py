"""Firewall zones of extra_uci that take over the management network (MC929)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import created_sections, with_extra
from meshctl.model import Fleet
from meshctl.uci import Package, Section

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
)
def zone_taken(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        firewall = packages.get("firewall")
        created = dict(created_sections(node, packages, "firewall"))
        own = [] if firewall is None else [zone for zone in firewall.of_type("zone") if zone.name not in created]
        for name, zone in created.items():
            if zone.type == "zone":
                for keys, message, expected, found in _shared(name, zone, own, packages):
                    key = next((key for key in keys if key in node.extra_uci), f"firewall.{name}")
                    yield Finding(("nodes", node.name, "extra_uci", key), message, expected, found)


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
