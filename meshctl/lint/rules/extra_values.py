"""Values of extra_uci that OpenWrt does not understand (MC918)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from ipaddress import IPv4Network, IPv6Network, ip_interface

from meshctl.diagnostics import Severity
from meshctl.lint.context import LintContext
from meshctl.lint.openwrt_names import one_edit_apart
from meshctl.lint.rule import Finding, fleet_rule
from meshctl.lint.rules.rendering import extra_entries, with_extra
from meshctl.model import Fleet
from meshctl.suggest import did_you_mean, suggestion

# what is wrong with a value: what was expected, and a hint; None if nothing is
_Check = Callable[[str], tuple[str, str] | None]

_MAX_SSID_BYTES = 32
_MAX_VLAN = 4094
# dnsmasq and odhcpd make a shorter lease this long
_MIN_LEASE_S = 120
_UNIQUE_LOCAL = IPv6Network("fc00::/7")
# OpenWrt's wifi scripts look for these in the value
_METHODS = ("psk", "sae", "owe", "wpa", "wep", "8021x")


def _one_of(*words: str) -> _Check:
    def check(value: str) -> tuple[str, str] | None:
        return None if value in words else (f"one of {', '.join(words)}", did_you_mean(value, words))

    return check


def _not_misspelled(*words: str) -> _Check:
    """Packages add further words, so only what is almost one of these is wrong."""

    def check(value: str) -> tuple[str, str] | None:
        near = () if value in words else _meant(value, words)
        return (" or ".join(near), suggestion(near)) if near else None

    return check


def _meant(value: str, words: tuple[str, ...]) -> tuple[str, ...]:
    """The words that a value probably means: with a typo, in other letters, or its first half (`forward`)."""
    lower = value.lower()
    cut = tuple(word for word in words if word.startswith(lower) and 2 * len(lower) >= len(word))
    return one_edit_apart(value, words) or cut


def _number(least: int, most: int) -> _Check:
    def check(value: str) -> tuple[str, str] | None:
        is_valid = value.isascii() and value.isdecimal() and least <= int(value) <= most
        return None if is_valid else (f"a number from {least} to {most}", "")

    return check


def _mac(value: str) -> tuple[str, str] | None:
    return None if value == "random" or _MAC.fullmatch(value) else ("a MAC address such as 02:ca:fe:00:00:01", "")


def _lease_time(value: str) -> tuple[str, str] | None:
    if value.isascii() and value.isdecimal() and int(value) < _MIN_LEASE_S:
        return f"a time with its unit, such as {value}h", "a number alone is seconds; a lease has 2 minutes at least"
    return None if _LEASE_TIME.fullmatch(value) else ("a time such as 30m, 12h or infinite", "")


def _ssid(value: str) -> tuple[str, str] | None:
    return None if len(value.encode()) <= _MAX_SSID_BYTES else (f"at most {_MAX_SSID_BYTES} bytes", "")


def _encryption(value: str) -> tuple[str, str] | None:
    if value == "none" or any(method in value for method in _METHODS):
        return None
    return "none, owe, psk2, sae or another method of OpenWrt", "an unknown method is no encryption"


def _addresses(value: str) -> tuple[str, str] | None:
    try:
        for word in value.split():
            ip_interface(word)
    except ValueError:
        return "an IP address", ""
    return None


def _ula_prefix(value: str) -> tuple[str, str] | None:
    try:
        is_valid = value == "auto" or IPv6Network(value).subnet_of(_UNIQUE_LOCAL)
    except ValueError:
        is_valid = False
    return None if is_valid else ("auto, or a prefix in fc00::/7 such as fd42:80::/48", "")


def _netmask(value: str) -> tuple[str, str] | None:
    try:
        IPv4Network(f"0.0.0.0/{value}")
    except ValueError:
        return "a netmask such as 255.255.255.0", ""
    return None


def _vlan_device(value: str) -> tuple[str, str] | None:
    name, _, vlan = value.rpartition(".")
    is_valid = not name or not vlan.isdecimal() or 1 <= int(vlan) <= _MAX_VLAN
    return None if is_valid else (f"a VLAN from 1 to {_MAX_VLAN} behind the port", "")


_MAC = re.compile(r"[0-9a-f]{2}(:[0-9a-f]{2}){5}", re.IGNORECASE)
_LEASE_TIME = re.compile(r"\d+[smhdw]?|infinite", re.ASCII)
# netifd drops a value that is none of these, and the option has its default (libuci, blob.c)
_SWITCH = _one_of("0", "1", "false", "true")
_SWITCHES = {
    "wifi-device": ("disabled", "noscan", "legacy_rates", "country_ie"),
    "wifi-iface": (
        "disabled",
        "hidden",
        "isolate",
        "wds",
        "wmm",
        "short_preamble",
        "multicast_to_unicast",
        "proxy_arp",
    ),
}
_POLICY = _one_of("ACCEPT", "REJECT", "DROP")
_HTMODES = (
    *("NOHT", "NONE", "HT20", "HT40", "HT40+", "HT40-", "VHT20", "VHT40", "VHT80", "VHT160", "VHT80_80"),
    *(f"{standard}{width}" for standard in ("HE", "EHT") for width in (20, 40, 80, 160)),
    "EHT320",
)
_CHECKS: dict[tuple[str, str, str], _Check] = {
    ("wireless", "wifi-device", "htmode"): _one_of(*_HTMODES),
    ("wireless", "wifi-iface", "mode"): _one_of("ap", "sta", "adhoc", "mesh", "monitor"),
    ("wireless", "wifi-iface", "ssid"): _ssid,
    ("wireless", "wifi-iface", "encryption"): _encryption,
    ("wireless", "wifi-iface", "macaddr"): _mac,
    ("wireless", "wifi-iface", "dtim_period"): _number(1, 255),
    ("wireless", "wifi-iface", "maxassoc"): _number(0, 2007),
    **{("wireless", kind, option): _SWITCH for kind, options in _SWITCHES.items() for option in options},
    ("dhcp", "dhcp", "start"): _number(0, 2**24),
    ("dhcp", "dhcp", "limit"): _number(1, 2**24),
    ("dhcp", "dhcp", "leasetime"): _lease_time,
    ("network", "interface", "proto"): _not_misspelled("static", "dhcp", "dhcpv6", "none", "pppoe", "wireguard"),
    ("network", "interface", "device"): _vlan_device,
    ("network", "interface", "ipaddr"): _addresses,
    ("network", "interface", "ip6addr"): _addresses,
    ("network", "interface", "netmask"): _netmask,
    ("network", "interface", "gw_mode"): _one_of("off", "client", "server"),
    ("network", "globals", "ula_prefix"): _ula_prefix,
    **{("firewall", kind, chain): _POLICY for kind in ("defaults", "zone") for chain in ("input", "output", "forward")},
    ("firewall", "rule", "target"): _not_misspelled("ACCEPT", "REJECT", "DROP", "MARK", "NOTRACK"),
    ("firewall", "redirect", "target"): _not_misspelled("DNAT", "SNAT"),
}
_TYPES = {
    "wireless": _not_misspelled("wifi-iface", "wifi-device"),
    "network": _not_misspelled("interface", "device", "globals", "route", "route6", "rule", "rule6", "switch_vlan"),
    "firewall": _not_misspelled("zone", "forwarding", "rule", "redirect", "include", "ipset"),
    "dhcp": _not_misspelled("dhcp", "dnsmasq", "host", "odhcpd"),
}


@fleet_rule(
    "MC918",
    Severity.ERROR,
    "A value of extra_uci is not one that OpenWrt understands",
    why="""UCI stores any text. An access point with a mistyped `encryption` is open, one with a mistyped `mode` is not
    on the air, a zone with a mistyped policy is not loaded, and a section with a mistyped type is not read: no program
    says so.""",
    fix="Correct the value.",
    failing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: app,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    passing="""
    nodes: {b01: {extra_uci: {wireless.guest: wifi-iface, wireless.guest.device: radio0, wireless.guest.mode: ap,
      wireless.guest.ssid: guests, wireless.guest.network: visitors, network.visitors: interface,
      network.visitors.proto: none}}}
    """,
    is_per_kind=True,
)
def value_unknown(fleet: Fleet, context: LintContext) -> Iterator[Finding]:
    for node, packages in with_extra(fleet, context):
        for key, value, package, section, option in extra_entries(node, packages):
            check = None if option else _TYPES.get(package)
            if section is not None:
                check = _CHECKS.get((package, section.type, option))
            wrong = check(value) if check is not None and value else None
            if wrong is not None:
                path = ("nodes", node.name, "extra_uci", key)
                yield Finding(path, "OpenWrt does not understand this value", wrong[0], value, wrong[1])
