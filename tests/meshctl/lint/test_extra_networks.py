"""Access points, interfaces and DHCP servers of extra_uci: findings beside the rules' own examples, and silence."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
_GUIDE = Path(__file__).parents[3] / "docs" / "how-to" / "access-points.md"
# its operators have an RSA key, which 19.07 needs
_COMMUNITY = Path(__file__).parents[3] / "inventory" / "community" / "fleet.yaml"
_ROUTED = "robots: {husky1: {lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24}}}"
_OWN = "network.own: interface, network.own.proto: static, network.own.device: eth1"
_SERVER = "dhcp.dns: dnsmasq, dhcp.dns.authoritative: '1'"


def _found(extra: str, directory: Path, *, node: str = "b01", other: str = "") -> list[Diagnostic]:
    example = Example(f"nodes: {{{node}: {{extra_uci: {{{extra}}}}}}}\n{other}")
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


def _codes(extra: str, directory: Path, *, node: str = "b01", other: str = "") -> list[str]:
    return [one.code for one in _found(extra, directory, node=node, other=other)]


def test_a_range_on_lan_needs_a_server_and_ipv4(tmp_path: Path) -> None:
    (finding,) = _found("dhcp.lan.ignore: '', dhcp.lan.start: '1000'", tmp_path)
    assert (finding.code, finding.path) == ("MC914", "nodes.b01.extra_uci.dhcp.lan.ignore")
    assert finding.expected == "a section of the type dnsmasq and dhcp.lan.dhcpv4: server"
    assert _codes(f"dhcp.lan.ignore: '', dhcp.lan.dhcpv4: server, dhcp.lan.start: '150', {_SERVER}", tmp_path) == []


def test_a_range_in_a_network_of_its_own_needs_a_server(tmp_path: Path) -> None:
    extra = f"{_OWN}, network.own.ipaddr: 172.20.0.1/24, dhcp.own: dhcp, dhcp.own.interface: own"
    assert _codes(extra, tmp_path) == ["MC914"]
    assert _codes(f"{extra}, dhcp.own.start: '100', {_SERVER}", tmp_path) == []
    assert _codes(f"{extra}, dhcp.own.dhcpv4: server, dhcp.odhcpd.maindhcp: '1'", tmp_path) == []


@pytest.mark.parametrize("extra", ["dhcp.own.ra: server, dhcp.own.dhcpv6: server", "dhcp.own.ignore: '1'"])
def test_router_advertisements_and_ignored_networks_need_no_dnsmasq(extra: str, tmp_path: Path) -> None:
    given = f"{_OWN}, network.own.ip6addr: 'fd99::1/64', dhcp.own: dhcp, dhcp.own.interface: own, {extra}"
    assert _codes(given, tmp_path) == []


@pytest.mark.parametrize("address", ["10.42.0.200/25", "10.0.0.1/8", "172.20.0.1/24 10.42.0.9/24"])
def test_an_interface_in_the_mesh_network_is_reported(address: str, tmp_path: Path) -> None:
    assert _codes(f"{_OWN}, network.own.ipaddr: {address}", tmp_path) == ["MC915"]


def test_an_interface_in_another_robots_lan_is_reported(tmp_path: Path) -> None:
    (finding,) = _found(f"{_OWN}, network.own.ipaddr: 10.43.1.9/24", tmp_path, other=_ROUTED)
    assert (finding.code, finding.message) == ("MC915", "overlaps 10.43.1.0/24 of a robot's LAN")


@pytest.mark.parametrize("device", ["'@lan'", "br-lan"])
def test_a_second_address_on_the_same_device_is_no_overlap(device: str, tmp_path: Path) -> None:
    extra = f"network.own: interface, network.own.proto: static, network.own.device: {device}"
    assert _codes(f"{extra}, network.own.ipaddr: 10.42.0.210/24", tmp_path) == []


@pytest.mark.parametrize("ending", ["network.own.ipaddr: 10.43.0.1/24", "network.own.ipaddr: ''"])
def test_other_networks_do_not_overlap(ending: str, tmp_path: Path) -> None:
    assert "MC915" not in _codes(f"{_OWN}, {ending}", tmp_path)


def _wifi(mode: str, network: str, encryption: str = "none") -> str:
    options = {"device": "radio0", "mode": mode, "ssid": "hq", "encryption": encryption, "network": network}
    return ", ".join(["wireless.w: wifi-iface", *(f"wireless.w.{name}: {value}" for name, value in options.items())])


@pytest.mark.parametrize("network", ["mesh0", "bat0"])
def test_nothing_else_is_attached_to_the_meshes_networks(network: str, tmp_path: Path) -> None:
    (finding,) = _found(_wifi("ap", network), tmp_path)
    assert (finding.code, finding.path) == ("MC916", "nodes.b01.extra_uci.wireless.w.network")


@pytest.mark.parametrize("release", ["'24.10'", "'19.07'"])
def test_a_client_interface_in_a_bridge_needs_four_addresses(release: str, tmp_path: Path) -> None:
    keys = yaml.safe_load(_COMMUNITY.read_text())["operators"]["ssh_keys"]
    other = f"hardware: {{rocket: {{release: {release}}}}}\noperators: {{ssh_keys: {keys}}}"
    assert "MC916" in _codes(_wifi("sta", "lan"), tmp_path, other=other)
    assert "MC916" not in _codes(_wifi("sta", "lan") + ", wireless.w.wds: '1'", tmp_path, other=other)
    uplink = ", network.up: interface, network.up.proto: dhcp"
    assert "MC916" not in _codes(_wifi("sta", "up") + uplink, tmp_path, other=other)


@pytest.mark.parametrize("encryption", ["none", "owe"])
def test_an_open_access_point_in_the_robots_network_is_reported(encryption: str, tmp_path: Path) -> None:
    assert _codes(_wifi("ap", "lan", encryption), tmp_path) == ["MC917"]


def test_an_open_access_point_in_a_routed_robots_lan_is_reported(tmp_path: Path) -> None:
    assert "MC917" in _codes(_wifi("ap", "lan"), tmp_path, node="husky1-front", other=_ROUTED)


def test_an_open_access_point_where_no_robot_is_may_be_meant(tmp_path: Path) -> None:
    other = "robots: <removed>\ntopics: <removed>\nudp_mesh: <removed>"
    assert "MC917" not in _codes(_wifi("ap", "lan"), tmp_path, other=other)


def test_the_recipes_of_the_guide_pass(tmp_path: Path) -> None:
    """Each block of the guide, in a fleet without robots and with a radio1 of its band: lint reports none."""
    blocks = [block.split("```")[0] for block in _GUIDE.read_text().split("```yaml\n")[1:]]
    recipes = [extra for block in blocks for extra in _extras(yaml.safe_load(block))]
    assert len(recipes) >= 4
    for number, extra in enumerate(recipes):
        listed = ", ".join(f"{key!r}: {str(value)!r}" for key, value in extra.items())
        hardware = "hardware: {rocket: {lan_ports: [eth1], radios: {radio1: {band: 2g}}}}"
        other = f"robots: <removed>\ntopics: <removed>\nudp_mesh: <removed>\n{hardware}"
        directory = tmp_path / str(number)
        directory.mkdir()
        assert not [code for code in _codes(listed, directory, other=other) if code.startswith("MC9")]


def _extras(block: object) -> list[dict[str, str]]:
    if not isinstance(block, dict):
        return []
    own = [block["extra_uci"]] if "extra_uci" in block else []
    return own + [extra for value in block.values() for extra in _extras(value)]
