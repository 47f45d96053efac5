"""Services that extra_uci adds to nodes: access points, uplinks, DHCP servers (MC911 to MC913)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.grouping import group_by_key
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import with_extra
from meshctl.model import Fleet
from meshctl.uci import Package, Section
from meshctl.wording import join_limited

# of hostapd's encryptions, those with a passphrase that every client knows
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
      wireless.guest.ssid: guests, wireless.guest.network: lan, wireless.guest.encryption: owe}}}
    """,
)
def passphrase_missing(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in _created(node.extra_uci, packages.get("wireless"), "wireless"):
            encryption = interface.get("encryption")
            given = any(interface.get(option) for option in ("key", "sae_password", "wpa_psk_file", "key1"))
            if interface.type == "wifi-iface" and encryption.startswith(_WITH_PASSPHRASE) and not given:
                path = ("nodes", node.name, "extra_uci", f"wireless.{name}.encryption")
                yield Finding(path, "needs a passphrase, which extra_uci cannot hold", "none or owe", encryption)


@fleet_rule(
    "MC912",
    Severity.ERROR,
    "An interface of extra_uci uses a port of the bridge",
    why="""A port of `lan_ports` belongs to the bridge br-lan: the kernel hands what arrives there to the bridge, so an
    interface on the port itself gets no address and no answer.""",
    fix="Take the port out of `lan_ports` of the hardware profile or of the node, or name another port.",
    failing="nodes: {b01: {extra_uci: {network.wan: interface, network.wan.proto: dhcp, network.wan.device: eth0}}}",
    passing="nodes: {b01: {extra_uci: {network.wan: interface, network.wan.proto: dhcp, network.wan.device: eth1}}}",
)
def port_used_twice(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in _created(node.extra_uci, packages.get("network"), "network"):
            for option in ("device", "ifname"):
                found = [port for port in interface.get(option).split() if port in node.lan_ports]
                if interface.type == "interface" and found:
                    path = ("nodes", node.name, "extra_uci", f"network.{name}.{option}")
                    yield Finding(path, "bridged into br-lan", "a port that is not in lan_ports", join_limited(found))


def _created(extra: Mapping[str, str], package: Package | None, name: str) -> Iterator[tuple[str, Section]]:
    """The named sections that `extra_uci` creates in a package."""
    for section in () if package is None else package.sections:
        if section.name is not None and f"{name}.{section.name}" in extra:
            yield section.name, section


@fleet_rule(
    "MC913",
    Severity.WARNING,
    "Several nodes of one network serve addresses",
    why="""The mesh is one broadcast domain: with several DHCP servers a client takes the first answer, and two servers
    give the same address to two clients. batman-adv sends requests to one gateway only if the servers are its
    gateways.""",
    fix="""Turn on the DHCP server of one node, or set `network.bat0.gw_mode: server` on those that have one and
    give each a range of its own.""",
    failing="groups: {serving: {extra_uci: {dhcp.lan.ignore: '0'}}}\n"
    "nodes: {base: {groups: [serving]}, b01: {groups: [serving]}}",
    passing="nodes: {base: {extra_uci: {dhcp.lan.ignore: '0'}}}",
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
