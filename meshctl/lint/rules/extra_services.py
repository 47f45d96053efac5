"""Services that extra_uci adds to nodes: access points, uplinks, DHCP servers (MC911 to MC913)."""

from __future__ import annotations

from collections.abc import Iterator

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import created_sections, with_extra
from meshctl.model import Fleet, Node
from meshctl.uci import Package
from meshctl.wording import join_limited

# hostapd's encryptions with a passphrase that every client knows
_WITH_PASSPHRASE = ("psk", "sae", "wep")


@fleet_rule(
    "MC911",
    Severity.ERROR,
    "An access point of extra_uci has a passphrase's encryption and no passphrase",
    why="""hostapd refuses such an interface: the access point is not on the air. `extra_uci` holds no passphrases, as
    they would be readable in the repository.""",
    fix="Use `none`, or `owe` if the image's wpad supports it; or add the interface in a template of your own.",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: lan, wireless.guest.encryption: psk2}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, wireless.guest.encryption: owe,
      network.visitors: interface, network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def passphrase_missing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in created_sections(node, packages, "wireless"):
            encryption = interface.get("encryption")
            given = any(interface.get(option) for option in ("key", "sae_password", "wpa_psk_file", "key1"))
            if interface.type == "wifi-iface" and encryption.startswith(_WITH_PASSPHRASE) and not given:
                path = ("nodes", node.name, "extra_uci", f"wireless.{name}.encryption")
                yield Finding(path, "needs a passphrase, which extra_uci cannot hold", "none or owe", encryption)


@fleet_rule(
    "MC912",
    Severity.ERROR,
    "An interface or a bridge of extra_uci uses a port of the bridge",
    why="""A port of `lan_ports` and the mesh's `bat0` belong to the bridge br-lan: the kernel hands what arrives there
    to the bridge, so an interface on the port itself gets no address and no answer. A second bridge takes the port
    away: the node is no longer reachable through it.""",
    fix="""Take the port out of `lan_ports` of the hardware profile or of the node, or name another port, or a VLAN such
    as `bat0.30`.""",
    failing="nodes: {b01: {extra_uci: {network.wan: interface, network.wan.proto: dhcp, network.wan.device: eth0}}}",
    passing="nodes: {b01: {extra_uci: {network.wan: interface, network.wan.proto: dhcp, network.wan.device: eth1}}}",
    is_per_kind=True,
)
def port_used_twice(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        network = packages.get("network")
        taken = set(node.lan_ports) if network is None else {*node.lan_ports, *_bridged(node, network)}
        for name, section in created_sections(node, packages, "network"):
            for option in _PORT_OPTIONS.get(section.type, ()):
                found = [port for port in section.get(option).split() if port in taken]
                if found:
                    path = ("nodes", node.name, "extra_uci", f"network.{name}.{option}")
                    yield Finding(path, "bridged into br-lan", "a port that is not in br-lan", join_limited(found))


# where sections of these types name ports
_PORT_OPTIONS = {"interface": ("device", "ifname"), "device": ("ports", "ifname")}


def _bridged(node: Node, network: Package) -> Iterator[str]:
    """The ports of the bridges that are not in `extra_uci`."""
    for section in (*network.of_type("device"), *network.of_type("interface")):
        if section.get("type") == "bridge" and f"network.{section.name}" not in node.extra_uci:
            yield from (*section.get("ports").split(), *section.get("ifname").split())


@fleet_rule(
    "MC913",
    Severity.WARNING,
    "Several nodes of one network serve addresses",
    why="""The mesh is one broadcast domain: with several DHCP servers a client takes the first answer, and two servers
    give the same address to two clients. batman-adv sends requests to one gateway only if the servers are its
    gateways.""",
    fix="""Turn on the DHCP server of one node, or set `network.bat0.gw_mode: server` on those that have one and
    give each a range of its own.""",
    failing="""
    groups: {serving: {extra_uci: {dhcp.lan.ignore: '0', dhcp.lan.dhcpv4: server, dhcp.dns: dnsmasq,
      dhcp.dns.authoritative: '1', dhcp.lan.start: '120', dhcp.lan.limit: '50'}}}
    nodes: {base: {groups: [serving]}, b01: {groups: [serving]}}
    """,
    passing="""
    nodes: {base: {extra_uci: {dhcp.lan.ignore: '0', dhcp.lan.dhcpv4: server, dhcp.dns: dnsmasq,
      dhcp.dns.authoritative: '1', dhcp.lan.start: '120', dhcp.lan.limit: '50'}}}
    """,
)
def several_address_servers(fleet: Fleet, _context: LintContext) -> Iterator[Finding]:
    serving = [
        node
        for node in fleet.managed()
        if node.extra_uci.get("dhcp.lan.ignore") in ("", "0")
        and node.meshes
        and node.lan_address is None
        and node.extra_uci.get("network.bat0.gw_mode") != "server"
    ]
    for names in group_by_key((node.meshes[:1], node.name) for node in serving).values():
        if len(names) > 1:
            path = ("nodes", names[0], "extra_uci", "dhcp.lan.ignore")
            yield Finding(path, "DHCP is on in one network", "one DHCP server", join_limited(names))
