"""Names and values of extra_uci: mistakes are found at their key, and what is sound is not reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
# a guest network with its own bridge over the mesh, addresses and a way out: no findings
_SOUND = {
    "wireless.guest": "wifi-iface",
    "wireless.guest.device": "radio0",
    "wireless.guest.mode": "ap",
    "wireless.guest.ssid": "guests",
    "wireless.guest.encryption": "owe",
    "wireless.guest.network": "guests",
    "network.br_guests": "device",
    "network.br_guests.type": "bridge",
    "network.br_guests.name": "br-guests",
    "network.br_guests.ports": "bat0.30",
    "network.guests": "interface",
    "network.guests.device": "br-guests",
    "network.guests.proto": "static",
    "network.guests.ipaddr": "172.20.0.1",
    "network.guests.netmask": "255.255.252.0",
    "network.wan": "interface",
    "network.wan.device": "eth1",
    "network.wan.proto": "dhcp",
    "network.bat0.gw_mode": "server",
    "dhcp.dns": "dnsmasq",
    "dhcp.dns.authoritative": "1",
    "dhcp.guests": "dhcp",
    "dhcp.guests.interface": "guests",
    "dhcp.guests.start": "100",
    "firewall.guests": "zone",
    "firewall.guests.name": "visitors",
    "firewall.guests.network": "guests",
    "firewall.guests.input": "REJECT",
    "firewall.wan": "zone",
    "firewall.wan.name": "wan",
    "firewall.wan.network": "wan wan_6",
    "firewall.out": "forwarding",
    "firewall.out.src": "visitors",
    "firewall.out.dest": "wan",
    "firewall.dns": "rule",
    "firewall.dns.src": "*",
    "firewall.dns.target": "ACCEPT",
}


def _found(changes: dict[str, str], directory: Path) -> list[Diagnostic]:
    listed = ", ".join(f"{key!r}: {value!r}" for key, value in {**_SOUND, **changes}.items())
    example = Example(f"nodes: {{b01: {{extra_uci: {{{listed}}}}}}}")
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def test_a_sound_guest_network_is_not_reported(tmp_path: Path) -> None:
    assert _found({}, tmp_path) == []


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ("wireless.guest.network", "gusts", "MC904"),
        ("dhcp.guests.interface", "guest", "MC904"),
        ("firewall.guests.network", "guests lam", "MC904"),
        ("firewall.out.src", "guests", "MC904"),
        ("firewall.out.dest", "wann", "MC904"),
        ("firewall.dns.src", "lan", "MC904"),
        ("network.br_guests.ports", "bat0", "MC912"),
        ("network.br_guests.ports", "bat0.30 eth0", "MC912"),
        ("network.wan.device", "bat0", "MC912"),
        ("wireless.guest.mode", "app", "MC918"),
        ("wireless.guest.encryption", "pks2", "MC918"),
        ("wireless.guest.ssid", "Überschwemmung, Einsatzleitung Süd", "MC918"),
        ("network.wan.proto", "dchp", "MC918"),
        ("network.guests.ipaddr", "172.20.0.1.5", "MC918"),
        ("network.guests.netmask", "255.0.255.0", "MC918"),
        ("network.guests.netmask", "255.255.252", "MC918"),
        ("firewall.guests.input", "REJCT", "MC918"),
        ("firewall.dns.target", "ACEPT", "MC918"),
        ("network.guests", "interfaces", "MC918"),
        ("network.bat0.gw_mode", "srv", "MC918"),
        ("firewall.@defaults[0].forward", "ACCEPTED", "MC918"),
    ],
)
def test_a_mistake_is_reported_at_its_key(key: str, value: str, code: str, tmp_path: Path) -> None:
    found = [(one.code, one.path) for one in _found({key: value}, tmp_path)]
    assert (code, f"nodes.b01.extra_uci.{key}") in found


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("wireless.guest.encryption", "wpa2+ccmp"),
        ("wireless.guest.encryption", "none"),
        ("wireless.guest.ssid", "ä" * 16),
        ("network.wan.proto", "qmi"),
        ("network.guests.netmask", "22"),
        ("firewall.guests.network", ""),
        ("firewall.dns.target", "HELPER"),
        ("firewall.out.dest", "*"),
    ],
)
def test_what_openwrt_understands_is_not_reported(key: str, value: str, tmp_path: Path) -> None:
    assert _found({key: value}, tmp_path) == []


@pytest.mark.parametrize(("channel", "is_found"), [("5", False), ("auto", False), ("14", True), ("36", True)])
def test_the_channel_of_an_access_point_is_one_that_the_country_allows(
    channel: str, is_found: bool, tmp_path: Path
) -> None:
    extra = f"wireless.radio0.channel: '{channel}'"
    text = f"nodes: {{b01: {{radios: {{radio0: {{mesh: null}}}}, extra_uci: {{{extra}}}}}}}\n"
    example = Example(text)
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    assert [one.path for one in found if one.code == "MC919"] == (
        ["nodes.b01.extra_uci.wireless.radio0.channel"] if is_found else []
    )


@pytest.mark.parametrize(
    ("option", "expected"),
    [("devic", "device"), ("netwrk", "network"), ("ssid", ""), ("vendor_elements", ""), ("isolat", "isolate")],
)
def test_an_option_that_is_almost_a_known_one_is_reported(option: str, expected: str, tmp_path: Path) -> None:
    extra = f"wireless.guest: wifi-iface, wireless.guest.{option}: lan"
    example = Example(f"nodes: {{b01: {{extra_uci: {{{extra}}}}}}}\n")
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    assert [one.expected for one in found if one.code == "MC920"] == ([expected] if expected else [])


def test_an_emergency_stop_that_others_delay_is_reported_itself(tmp_path: Path) -> None:
    example = Example("topics: {estop: {priority: 9}}\n")
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    (stop,) = (one for one in found if one.code == "MC701")
    assert (stop.path, stop.expected, stop.found) == (
        "topics.estop.priority",
        "0, which no other topic has",
        "9",
    )


@pytest.mark.parametrize(("width", "is_found"), [("HT20", False), ("HE80", False), ("HT80", True), ("ht20", True)])
def test_the_width_of_an_access_points_channel_is_one_of_openwrts(width: str, is_found: bool, tmp_path: Path) -> None:
    example = Example(f"nodes: {{b01: {{extra_uci: {{wireless.radio1.htmode: {width}}}}}}}\n")
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    assert ("MC918" in [one.code for one in found]) is is_found
