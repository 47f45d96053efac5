"""Interfaces of extra_uci that OpenWrt does not bring up: what they lack, and their names (MC921 to MC925)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.channel import channel_or_width
from meshctl.lint.rules.drivers import generation, htmode_limits
from meshctl.lint.rules.extra_networks import is_on
from meshctl.lint.rules.rendering import created_sections, extra_entries, with_extra
from meshctl.model import Band, Fleet, Node
from meshctl.regdb import CHANNELS, NO_INITIATE, initiating_channels, legal_channels
from meshctl.uci import Package, Section

# IFNAMSIZ of the kernel, less the end of the text
_MAX_NAME_BYTES = 15
# what a wireless interface of each mode cannot do without; hostapd and iw refuse an empty name
_NEEDED = {
    "ap": ("device", "ssid"),
    "sta": ("device", "ssid"),
    "adhoc": ("device", "ssid"),
    "mesh": ("device", "mesh_id"),
    "": ("device", "mode", "ssid"),
}
# of other packages, whatever the mode (fw3, fw4, netifd and dnsmasq's init script skip the section)
_NEEDED_ELSEWHERE = {
    ("firewall", "forwarding"): ("src", "dest"),
    ("firewall", "zone"): ("name",),
    ("network", "route"): ("interface",),
    ("network", "route6"): ("interface",),
    ("dhcp", "dhcp"): ("interface",),
}
_EXAMPLES = {
    "device": "radio1",
    "mode": "ap",
    "ssid": "my-guests",
    "mesh_id": "my-mesh",
    "network": "lan",
    "src": "management",
    "dest": "wan",
    "name": "wan",
    "interface": "lan",
}
_GUEST = """
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.encryption: owe, wireless.guest.network: visitors, MORE
      network.visitors: interface, network.visitors.proto: none}}}
    """
_CAMERA = """
    nodes: {b01: {extra_uci: {network.camera: interface, network.camera.device: eth1, MORE}}}
    """


@fleet_rule(
    "MC921",
    Severity.ERROR,
    "A section of extra_uci is incomplete",
    why="""A wireless interface without `device` is brought up by no radio, without `mode` not by OpenWrt; hostapd
    refuses an access point without a name, and what connects to one without `network` gets no address. The firewall
    ignores a forwarding without both of its zones and a zone without a name, dnsmasq a range and netifd a route without
    an interface. A change that adds such a section is rolled back, or it is there and does nothing.""",
    fix="Add the option that the finding names.",
    failing=_GUEST.replace("wireless.guest.ssid: guests,", "").replace("MORE", ""),
    passing=_GUEST.replace("MORE", ""),
    is_per_kind=True,
)
def section_incomplete(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for package in ("wireless", "network", "firewall", "dhcp"):
            for name, section in created_sections(node, packages, package):
                missing = [option for option in _needed(package, section) if not section.get(option)]
                if missing:
                    expected = " and ".join(f"{package}.{name}.{option}: {_EXAMPLES[option]}" for option in missing)
                    path = ("nodes", node.name, "extra_uci", f"{package}.{name}")
                    yield Finding(path, f"no {' and no '.join(missing)}", expected, "none")


def _needed(package: str, section: Section) -> tuple[str, ...]:
    """The options without which the section does nothing."""
    if (package, section.type) != ("wireless", "wifi-iface"):
        return _NEEDED_ELSEWHERE.get((package, section.type), ())
    needed = _NEEDED.get(section.get("mode"), ())
    if is_on(section, "disabled"):
        return ()
    # a bridge may name the interface instead
    return needed if not needed or section.get("ifname") else (*needed, "network")


@fleet_rule(
    "MC922",
    Severity.WARNING,
    "An access point of extra_uci is on a radio that is off",
    why="""A radio that joins no mesh is off (`disabled: "1"`), and with it every interface on it: the access point is
    not on the air, and no program says so.""",
    fix="""Set `wireless.radio1.disabled: "0"` with the name of the radio, its channel and its htmode. To turn the
    access point off on purpose, set `disabled` of its own section.""",
    failing=_GUEST.replace("radio0", "radio1").replace("MORE", ""),
    passing=_GUEST.replace("radio0", "radio1").replace("MORE", "wireless.radio1.disabled: '0',"),
    is_per_kind=True,
)
def radio_off(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in created_sections(node, packages, "wireless"):
            radio = packages["wireless"].section(interface.get("device")) if interface.get("device") else None
            if interface.type != "wifi-iface" or radio is None or is_on(interface, "disabled"):
                continue
            if is_on(radio, "disabled"):
                switch = f"wireless.{radio.name}.disabled"
                key = switch if switch in node.extra_uci else f"wireless.{name}.device"
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, f"{radio.name} is off", f'{switch}: "0"', f'"{radio.get("disabled")}"')


@fleet_rule(
    "MC923",
    Severity.ERROR,
    "An interface's name in extra_uci is taken or too long",
    why="""The kernel has one interface of a name, and no names of more than 15 bytes. An interface with the name of the
    mesh's keeps the mesh down, and with it the node; one with a longer name is not created.""",
    fix="Choose another name of at most 15 letters, digits and hyphens, or leave out `ifname`.",
    failing=_GUEST.replace("MORE", "wireless.guest.ifname: mesh0,"),
    passing=_GUEST.replace("MORE", "wireless.guest.ifname: guest0,"),
    is_per_kind=True,
)
def name_unusable(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for key, value, package, section, option in extra_entries(node, packages):
            kind = (package, section.type, option) if section is not None else None
            if kind not in (("wireless", "wifi-iface", "ifname"), ("network", "device", "name")) or not value:
                continue
            path = ("nodes", node.name, "extra_uci", key)
            if len(value.encode()) > _MAX_NAME_BYTES:
                found = f"{value} ({len(value.encode())} bytes)"
                yield Finding(path, "too long for an interface", f"at most {_MAX_NAME_BYTES} bytes", found)
            elif section is not None and package == "wireless" and value in _taken(node, packages, section):
                yield Finding(path, "another interface has this name", "a name of its own", value)


def _taken(node: Node, packages: Mapping[str, Package], section: Section) -> set[str]:
    """The names of the node's other interfaces."""
    wireless, network = packages.get("wireless"), packages.get("network")
    others = () if wireless is None else wireless.of_type("wifi-iface")
    names = {"lo", *node.lan_ports, *(other.get("ifname") for other in others if other is not section)}
    if network is not None:
        names.update(device.get("name") for device in network.of_type("device"))
        names.update(
            interface.name or ""
            for interface in network.of_type("interface")
            if interface.get("proto") in ("batadv", "gre", "wireguard")
        )
    return names - {""}


@fleet_rule(
    "MC924",
    Severity.WARNING,
    "An interface of extra_uci gets no address",
    why="""netifd brings up what the section says and nothing else: without `proto` there is no address, a static
    interface needs one, an address without its netmask reaches nothing but itself, and without a device or an access
    point there is nothing to bring up.""",
    fix="Add the option that the finding names; `proto: none` states that the interface has no address.",
    failing=_CAMERA.replace("MORE", "network.camera.proto: static, network.camera.ipaddr: 172.20.0.1"),
    passing=_CAMERA.replace("MORE", "network.camera.proto: static, network.camera.ipaddr: 172.20.0.1/24"),
    is_per_kind=True,
)
def interface_without_address(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for name, interface in created_sections(node, packages, "network"):
            if interface.type == "interface":
                missing = _missing(name, interface, packages)
                if missing:
                    path = ("nodes", node.name, "extra_uci", f"network.{name}")
                    yield Finding(path, "incomplete interface", f"network.{name}.{missing}", "none")


def _missing(name: str, interface: Section, packages: Mapping[str, Package]) -> str:
    """The option that the interface lacks, with an example of its value; empty if it lacks none."""
    proto = interface.get("proto")
    if not proto:
        return "proto: dhcp"
    if proto == "static":
        addresses = interface.get("ipaddr").split()
        if not addresses and not any(interface.get(option) for option in ("ip6addr", "ip6assign", "ip6prefix")):
            return "ipaddr: 192.168.5.1/24"
        if not interface.get("netmask") and any("/" not in address for address in addresses):
            return "netmask: 255.255.255.0"
    if proto in ("static", "dhcp", "dhcpv6", "pppoe") and not _has_device(name, interface, packages):
        return "device: eth1"
    return ""


def _has_device(name: str, interface: Section, packages: Mapping[str, Package]) -> bool:
    wireless = packages.get("wireless")
    attached = () if wireless is None else wireless.of_type("wifi-iface")
    return (
        any(interface.get(option) for option in ("device", "ifname"))
        or interface.get("type") == "bridge"
        or any(name in other.get("network").split() for other in attached)
    )


@fleet_rule(
    "MC925",
    Severity.WARNING,
    "A radio does not support an htmode of extra_uci",
    why="""802.11n radios know no VHT, 802.11ac ones no HE, OpenWrt ignores VHT at 2.4 GHz, and a wide channel needs
    room beside it. The access point is then slow, narrow, or not on the air.""",
    fix="Use HT20 or HT40 with 802.11n, VHT with 802.11ac at 5 GHz, HE with Wi-Fi 6; or a channel with room.",
    failing="""
    hardware: {rocket: {radios: {radio1: {driver: ath10k-ct}}}}
    nodes: {b01: {extra_uci: {wireless.radio1.channel: '36', wireless.radio1.htmode: HE80}}}
    """,
    passing="""
    hardware: {rocket: {radios: {radio1: {driver: ath10k-ct}}}}
    nodes: {b01: {extra_uci: {wireless.radio1.channel: '36', wireless.radio1.htmode: VHT80}}}
    """,
    is_per_kind=True,
)
def extra_htmode(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    country = context.regdb.country(fleet.country)
    for node, packages in with_extra(fleet, context):
        radios = {radio.name: radio.hardware for radio in node.radios}
        for key, value, package, section, option in extra_entries(node, packages):
            radio = radios.get(section.name or "") if section is not None and package == "wireless" else None
            if radio is None or section is None or option != "htmode" or generation(value) not in _HT_GENERATIONS:
                continue
            path = ("nodes", node.name, "extra_uci", key)
            limits = list(htmode_limits(node, radio, value))
            if limits:
                yield Finding(path, f"{limits[0]} has no {generation(value)}", "an htmode that it supports", value)
                continue
            if radio.band is Band.G2 and generation(value) == "VHT":
                yield Finding(path, "ignored in the 2g band", "HT20 or HT40", value)
                continue
            channel = section.get("channel")
            if country is None or value not in _PLACEABLE or channel not in map(str, CHANNELS[radio.band]):
                continue
            legal = legal_channels(country, radio.band, value, forbidden=NO_INITIATE)
            if int(channel) in initiating_channels(country, radio.band) and int(channel) not in legal:
                expected = channel_or_width(legal)
                yield Finding(path, f"channel {channel} may not be this wide", expected, value)


_HT_GENERATIONS = ("HT", "VHT", "HE", "EHT")
_PLACEABLE = frozenset(
    ["HT20", "HT40", "HT40+", "HT40-", *(f"{kind}{width}" for kind in ("VHT", "HE") for width in (20, 40, 80, 160))]
)
