"""Uplinks and zones in extra_uci: what takes over the mesh's zone, and options that no program reads."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
# an uplink with its zone and an office's network with addresses: no findings of this package
_SOUND = {
    "network.bat0.gw_mode": "server",
    "network.wan": "interface",
    "network.wan.device": "eth1",
    "network.wan.proto": "dhcp",
    "firewall.wan": "zone",
    "firewall.wan.name": "wan",
    "firewall.wan.network": "wan",
    "firewall.wan.input": "REJECT",
    "firewall.wan.masq": "1",
    "network.office": "interface",
    "network.office.device": "eth2.40",
    "network.office.proto": "static",
    "network.office.ipaddr": "172.20.0.1",
    "network.office.netmask": "255.255.255.0",
    "dhcp.dns": "dnsmasq",
    "dhcp.dns.authoritative": "1",
    "dhcp.office": "dhcp",
    "dhcp.office.interface": "office",
    "dhcp.office.start": "20",
    "dhcp.office.leasetime": "1h",
}


def _found(changes: dict[str, str | None], directory: Path) -> list[Diagnostic]:
    options = {key: value for key, value in {**_SOUND, **changes}.items() if value is not None}
    entries = "".join(f"      {key}: {value!r}\n" for key, value in options.items())
    example = Example(f"nodes:\n  b01:\n    extra_uci:\n{entries}")
    found = check_path(write(example, directory), _REGDB, environment(example)).diagnostics
    return [one for one in found if one.code.startswith(("MC9", "MC529"))]


@pytest.mark.parametrize(
    ("wrong", "code"),
    [
        ({"wireless.radio0 .rts": "500"}, "MC903"),
        ({"network.nosuch.mtu": "1400"}, "MC901"),
    ],
)
def test_an_open_uplink_is_reported_beside_an_option_that_prevents_rendering(
    wrong: dict[str, str | None], code: str, tmp_path: Path
) -> None:
    found = _found({"firewall.wan.input": "ACCEPT", **wrong}, tmp_path)
    assert [one.code for one in found if one.code in (code, "MC930")] == ["MC930", code]


def test_an_open_uplink_is_reported_beside_a_mesh_that_prevents_rendering(tmp_path: Path) -> None:
    options = "".join(f"      {key}: {value!r}\n" for key, value in {**_SOUND, "firewall.wan.input": "ACCEPT"}.items())
    example = Example(f'meshes: {{main: {{ssid: "a\\tb"}}}}\nnodes:\n  b01:\n    extra_uci:\n{options}')
    found = [one.code for one in check_path(write(example, tmp_path), _REGDB, environment(example)).diagnostics]
    assert "MC930" in found
    assert len(found) > 1


def test_an_uplink_and_an_office_are_sound(tmp_path: Path) -> None:
    assert _found({}, tmp_path) == []


@pytest.mark.parametrize(
    ("changes", "key", "found"),
    [
        ({"firewall.wan.name": "management"}, "firewall.wan.name", "management"),
        ({"firewall.wan.network": "wan lan"}, "firewall.wan.network", "lan"),
        ({"network.wan.device": "br-lan"}, "network.wan.device", "br-lan"),
        ({"network.wan.device": "@lan"}, "network.wan.device", "br-lan"),
    ],
)
def test_a_zone_that_takes_over_the_mesh_is_reported(
    changes: dict[str, str | None], key: str, found: str, tmp_path: Path
) -> None:
    findings = [one for one in _found(changes, tmp_path) if one.code == "MC929"]
    assert [(one.path, one.found) for one in findings] == [(f"nodes.b01.extra_uci.{key}", found)]


def test_a_further_address_on_the_bridge_is_in_the_zone_of_the_mesh_and_sound(tmp_path: Path) -> None:
    second = {"network.second": "interface", "network.second.device": "br-lan", "network.second.proto": "static"}
    address = {"network.second.ipaddr": "172.21.0.1", "network.second.netmask": "255.255.255.0"}
    assert _found({**second, **address}, tmp_path) == []


@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        ("network.bat0.gw_mode", "network.bat0.gwmode"),
        ("network.wan.proto", "network.wan.prot"),
        ("firewall.wan.masq", "firewall.wan.masquerade"),
        ("firewall.wan.input", "firewall.wan.inptu"),
        ("dhcp.office.leasetime", "dhcp.office.lease"),
        ("dhcp.office.start", "dhcp.office.strat"),
    ],
)
def test_an_option_that_no_program_reads_is_reported(right: str, wrong: str, tmp_path: Path) -> None:
    findings = [one for one in _found({right: None, wrong: _SOUND[right]}, tmp_path) if one.code == "MC920"]
    expected = [(f"nodes.b01.extra_uci.{wrong}", right.rpartition(".")[2])]
    assert [(one.path, one.expected) for one in findings] == expected


@pytest.mark.parametrize("option", ["ip6deprecated", "dhcp_option", "uplink_vendor_extension"])
def test_other_options_of_packages_are_left_alone(option: str, tmp_path: Path) -> None:
    assert _found({f"network.wan.{option}": "1"}, tmp_path) == []


@pytest.mark.parametrize("vlan", ["0", "4095"])
def test_a_vlan_beyond_the_standard_s_is_reported(vlan: str, tmp_path: Path) -> None:
    (finding,) = _found({"network.office.device": f"eth2.{vlan}"}, tmp_path)
    assert (finding.code, finding.expected) == ("MC918", "a VLAN from 1 to 4094 behind the port")


def test_a_section_that_is_not_created_is_reported_once_for_each_option(tmp_path: Path) -> None:
    """MC529 said that network.wan.device "overrides a checked setting" of a section that is not there."""
    findings = _found({"network.wan": None}, tmp_path)
    assert {one.code for one in findings} == {"MC901"}
    assert [one.hint for one in findings] == [
        "create the section with a key of its own, `network.wan: TYPE`, or correct the name: did you mean 'lan'?"
    ] * 2


def test_an_unnamed_section_is_suggested(tmp_path: Path) -> None:
    (finding,) = _found({"system.system.ttylogin": "1"}, tmp_path)
    assert (finding.code, finding.hint) == ("MC901", "did you mean '@system[0]'?")


def test_an_address_without_its_netmask_is_one_finding(tmp_path: Path) -> None:
    """MC928 said "not in 172.20.0.1/32: expected 1 to -1"."""
    findings = _found({"network.office.netmask": None}, tmp_path)
    assert [one.code for one in findings] == ["MC924"]


_ANY_PORT = {"firewall.open": "rule", "firewall.open.src": "wan", "firewall.open.target": "ACCEPT"}
_FORWARDING = {"firewall.inward": "forwarding", "firewall.inward.src": "wan", "firewall.inward.dest": "management"}


@pytest.mark.parametrize(
    ("changes", "key", "found"),
    [
        ({"firewall.wan.input": "ACCEPT"}, "firewall.wan.input", "input ACCEPT"),
        ({"firewall.wan.input": None, "firewall.@defaults[0].input": "ACCEPT"}, "firewall.wan.network", "input ACCEPT"),
        (
            {
                "network.wan.proto": "static",
                "network.wan.ipaddr": "192.0.2.7/24",
                "network.wan.gateway": "192.0.2.1",
                "firewall.wan.input": "ACCEPT",
            },
            "firewall.wan.input",
            "input ACCEPT",
        ),
        (_FORWARDING, "firewall.inward.src", "src wan"),
        (_ANY_PORT, "firewall.open.src", "src wan"),
        (
            {**_ANY_PORT, "firewall.open.proto": "tcp", "firewall.open.dest": "management"},
            "firewall.open.src",
            "src wan",
        ),
        ({"firewall.management.network": "lan wan"}, "firewall.management.network", "input ACCEPT"),
    ],
)
def test_a_firewall_that_is_open_toward_an_uplink_is_reported(
    changes: dict[str, str | None], key: str, found: str, tmp_path: Path
) -> None:
    findings = [one for one in _found(changes, tmp_path) if one.code == "MC930"]
    assert [(one.path, one.found) for one in findings] == [(f"nodes.b01.extra_uci.{key}", found)]


@pytest.mark.parametrize(
    "changes",
    [
        # the office is the team's own network, and so may be a tunnel's other end
        {"firewall.office": "zone", "firewall.office.name": "office", "firewall.office.network": "office",
         "firewall.office.input": "ACCEPT"},
        {"network.wan.proto": "wireguard", "network.wan.device": None, "firewall.wan.input": "ACCEPT"},
        {**_FORWARDING, "firewall.inward.src": "management", "firewall.inward.dest": "wan"},
        {"firewall.wan.input": None},
        {**_ANY_PORT, "firewall.open.proto": "icmp"},
        {**_ANY_PORT, "firewall.open.dest_port": "22"},
        {**_ANY_PORT, "firewall.open.src_ip": "192.0.2.0/24"},
        {**_ANY_PORT, "firewall.open.target": "DROP"},
    ],
)  # fmt: skip
def test_a_firewall_that_is_closed_toward_its_uplink_is_sound(changes: dict[str, str | None], tmp_path: Path) -> None:
    assert [one for one in _found(changes, tmp_path) if one.code == "MC930"] == []


@pytest.mark.parametrize(
    ("address", "netmask", "codes"),
    [
        ("172.20.0.0", "255.255.255.0", ["MC931"]),
        ("172.20.0.255", "255.255.255.0", ["MC931"]),
        ("172.20.0.0/31", None, []),
        ("172.20.0.255", "255.255.0.0", []),
    ],
)
def test_the_address_of_a_network_is_no_interface_s(
    address: str, netmask: str | None, codes: list[str], tmp_path: Path
) -> None:
    changes = {"network.office.ipaddr": address, "network.office.netmask": netmask}
    assert [one.code for one in _found(changes, tmp_path) if one.code == "MC931"] == codes


@pytest.mark.parametrize(("time", "codes"), [("12", ["MC918"]), ("0", ["MC918"]), ("43200", []), ("12h", [])])
def test_a_lease_of_seconds_is_reported(time: str, codes: list[str], tmp_path: Path) -> None:
    assert [one.code for one in _found({"dhcp.office.leasetime": time}, tmp_path)] == codes
