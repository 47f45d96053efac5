"""Access points, interfaces and address ranges of extra_uci: what a newcomer leaves out or mistypes is found."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
# an access point on the radio that is in no mesh, an uplink, and addresses for guests: no findings
_SOUND = {
    "wireless.radio1.disabled": "0",
    "wireless.radio1.channel": "36",
    "wireless.radio1.htmode": "VHT20",
    "wireless.guest": "wifi-iface",
    "wireless.guest.device": "radio1",
    "wireless.guest.mode": "ap",
    "wireless.guest.ssid": "guests",
    "wireless.guest.encryption": "owe",
    "wireless.guest.isolate": "1",
    "wireless.guest.network": "visitors",
    "network.visitors": "interface",
    "network.visitors.proto": "static",
    "network.visitors.ipaddr": "172.20.0.1",
    "network.visitors.netmask": "255.255.255.0",
    "network.wan": "interface",
    "network.wan.device": "eth1",
    "network.wan.proto": "dhcp",
    "dhcp.dns": "dnsmasq",
    "dhcp.dns.authoritative": "1",
    "dhcp.lan.ignore": "",
    "dhcp.lan.dhcpv4": "server",
    "dhcp.lan.start": "150",
    "dhcp.lan.limit": "50",
    "dhcp.lan.leasetime": "1h",
}


def _found(changes: dict[str, str | None], directory: Path, other: str = "") -> list[Diagnostic]:
    """The findings with these values; None leaves a key out."""
    given = {key: value for key, value in {**_SOUND, **changes}.items() if value is not None}
    listed = ", ".join(f"{key!r}: {value!r}" for key, value in given.items())
    example = Example(f"nodes: {{b01: {{extra_uci: {{{listed}}}}}}}\n{other}")
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def test_a_sound_access_point_is_not_reported(tmp_path: Path) -> None:
    assert _found({}, tmp_path) == []


@pytest.mark.parametrize("option", ["device", "mode", "ssid", "network"])
def test_what_an_access_point_lacks_is_named(option: str, tmp_path: Path) -> None:
    (finding,) = [one for one in _found({f"wireless.guest.{option}": None}, tmp_path) if one.code == "MC921"]
    assert finding.path == "nodes.b01.extra_uci.wireless.guest"
    assert f"wireless.guest.{option}: " in finding.expected


def test_an_empty_name_is_no_name(tmp_path: Path) -> None:
    assert [one.code for one in _found({"wireless.guest.ssid": ""}, tmp_path)] == ["MC921"]


@pytest.mark.parametrize(
    "changes",
    [
        {"wireless.guest.disabled": "1", "wireless.guest.ssid": None},
        {"wireless.guest.network": None, "wireless.guest.ifname": "guest0", "network.visitors.device": "guest0"},
        {"wireless.guest.mode": "monitor", "wireless.guest.ssid": None, "network.visitors.proto": "none"},
    ],
)
def test_what_needs_no_name_or_network_is_not_reported(changes: dict[str, str | None], tmp_path: Path) -> None:
    assert not [one for one in _found(changes, tmp_path) if one.code == "MC921"]


@pytest.mark.parametrize("value", [None, "1", "true"])
def test_an_access_point_on_a_radio_that_is_off_is_reported(value: str | None, tmp_path: Path) -> None:
    (finding,) = _found({"wireless.radio1.disabled": value}, tmp_path)
    assert (finding.code, finding.expected) == ("MC922", 'wireless.radio1.disabled: "0"')


def test_an_access_point_that_is_off_itself_is_not_reported(tmp_path: Path) -> None:
    assert _found({"wireless.radio1.disabled": None, "wireless.guest.disabled": "1"}, tmp_path) == []


@pytest.mark.parametrize(
    ("key", "value", "code"),
    [
        ("wireless.guest.ifname", "mesh0", "MC923"),
        ("wireless.guest.ifname", "br-lan", "MC923"),
        ("wireless.guest.ifname", "guest-network-5g", "MC923"),
        ("network.wan.proto", None, "MC924"),
        ("network.wan.device", None, "MC924"),
        ("network.wan.proto", "static", "MC924"),
        ("network.visitors.netmask", None, "MC924"),
        ("network.visitors.ipaddr", None, "MC924"),
        ("wireless.radio1.htmode", "HT40-", "MC925"),
        ("wireless.radio1.htmode", "VHT160", "MC925"),
        ("dhcp.lan.start", "90", "MC926"),
        ("dhcp.lan.start", None, "MC926"),
        ("dhcp.lan.start", "1000", "MC928"),
        ("dhcp.lan.ignore", None, "MC914"),
        ("dhcp.lan.start", "10.42.0.150", "MC918"),
        ("dhcp.lan.limit", "many", "MC918"),
        ("dhcp.lan.leasetime", "1 hour", "MC918"),
        ("wireless.guest.isolate", "yes", "MC918"),
        ("wireless.guest.hidden", "on", "MC918"),
        ("wireless.guest.macaddr", "02:11:22:33:44", "MC918"),
        ("wireless.guest.dtim_period", "0", "MC918"),
        ("wireless.guest.maxassoc", "many", "MC918"),
        ("network.wan.proto", "DHCP", "MC918"),
    ],
)
def test_a_mistake_is_found(key: str, value: str | None, code: str, tmp_path: Path) -> None:
    findings = _found({key: value}, tmp_path)
    assert [one.code for one in findings] == [code]
    assert findings[0].path.startswith("nodes.b01.extra_uci.")


def test_a_section_type_cut_short_is_found(tmp_path: Path) -> None:
    zone = {"firewall.out": "forward", "firewall.out.src": "management", "firewall.out.dest": "management"}
    assert [(one.code, one.expected) for one in _found(dict(zone), tmp_path)] == [("MC918", "forwarding")]


@pytest.mark.parametrize("value", ["random", "02:11:22:33:44:55"])
def test_a_sound_address_of_an_access_point_is_not_reported(value: str, tmp_path: Path) -> None:
    assert _found({"wireless.guest.macaddr": value}, tmp_path) == []


def test_an_htmode_beyond_the_radio_names_its_driver(tmp_path: Path) -> None:
    hardware = "hardware: {rocket: {radios: {radio1: {driver: mt76x2}}}}"
    (finding,) = _found({"wireless.radio1.htmode": "HE80"}, tmp_path, hardware)
    assert (finding.code, finding.message) == ("MC925", "mt76x2 (radio1 of rocket) has no HE")


def test_a_range_with_a_robots_computer_names_it(tmp_path: Path) -> None:
    (finding,) = _found({"dhcp.lan.start": "105"}, tmp_path)
    assert (finding.code, finding.message) == ("MC926", "contains the computer of husky1 (10.42.0.110)")
    assert finding.found == "10.42.0.105 to 10.42.0.154"


def test_gateways_with_one_range_of_their_group_are_reported(tmp_path: Path) -> None:
    """They are rendered alike, and lint renders one of them only."""
    uci = "{network.bat0.gw_mode: server, dhcp.dns: dnsmasq, dhcp.dns.authoritative: '1', dhcp.lan.ignore: '', \
dhcp.lan.dhcpv4: server, dhcp.lan.start: '150', dhcp.lan.limit: '50'}"
    fleet = f"groups: {{gateways: {{extra_uci: {uci}}}}}\nnodes: {{'gw[1-3]': {{role: beacon, groups: [gateways], \
address: {{from: 10.42.0.120}}}}}}"
    example = Example(fleet)
    found = check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics
    (finding,) = [one for one in found if one.code == "MC927"]
    assert finding.message == "overlaps that of gw1 (also gw3)"


def test_a_range_that_is_off_on_purpose_is_not_reported(tmp_path: Path) -> None:
    assert _found({"dhcp.lan.ignore": "1", "dhcp.lan.start": "1"}, tmp_path) == []
