"""Mistakes of writing that lint accepted: each is found at its line, and what is sound beside it is not."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.engine import lint_texts
from meshctl.lint.example import environment, write
from meshctl.lint.openwrt_names import suggest_packages
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)


def _found(given: Example | str, directory: Path) -> list[Diagnostic]:
    example = Example(given) if isinstance(given, str) else given
    return list(check_path(write(example, directory), _REGDB, environment(example)).diagnostics)


@pytest.mark.parametrize("ports", ["[eth1 eth2]", "['eth1:eth2']", "['eth0/1']", "[a-name-of-16-letters]"])
def test_what_cannot_be_a_port_is_refused(ports: str, tmp_path: Path) -> None:
    (finding,) = _found(f"hardware: {{rocket: {{lan_ports: {ports}}}}}", tmp_path)
    assert (finding.code, finding.path) == ("INV021", "hardware.rocket.lan_ports.0")
    assert finding.expected == "the name of one port such as eth0.1, without blanks; commas separate ports"


@pytest.mark.parametrize("port", ["lan4.63", "lan1.20", "wan.7"])
def test_a_vlan_of_a_dsa_port_needs_no_switch_vlan(port: str, tmp_path: Path) -> None:
    assert _found(f"hardware: {{rocket: {{lan_ports: [{port}]}}}}", tmp_path) == []


@pytest.mark.parametrize("port", ["eth0", "eth0.1", "lan1", "wan", "lan-x"])
def test_ports_as_in_openwrt_are_accepted(port: str, tmp_path: Path) -> None:
    codes = {one.code for one in _found(f"hardware: {{rocket: {{lan_ports: [{port}]}}}}", tmp_path)}
    assert codes <= {"MC530"}


@pytest.mark.parametrize(
    ("host", "expected"),
    [
        ("gw.example:2222", "host: gw.example, port: 2222"),
        ("mesh@gw.example", "host: gw.example, user: mesh"),
        ("ssh://mesh@10.1.2.3:22", "host: 10.1.2.3, port: 22, user: mesh"),
        ("[fd51::1]:2222", "host: fd51::1, port: 2222"),
    ],
)
def test_a_user_or_port_in_a_host_is_reported_at_sites_too(host: str, expected: str, tmp_path: Path) -> None:
    found = [one for one in _found(f"sites: {{north: {{ssh: {{host: '{host}'}}}}}}", tmp_path) if one.code == "MC434"]
    assert [(one.path, one.expected, one.found) for one in found] == [("sites.north.ssh.host", expected, host)]


@pytest.mark.parametrize("host", ["gw.example", "10.1.2.3", "fd51::1", "fe80::5:6%eth0"])
def test_host_names_and_addresses_are_hosts(host: str, tmp_path: Path) -> None:
    found = _found(f"robots: {{husky1: {{computer: {{ssh: {{user: robot, host: '{host}'}}}}}}}}", tmp_path)
    assert "MC434" not in {one.code for one in found}


def test_underscores_are_no_hyphens_in_package_names() -> None:
    assert suggest_packages("kmod_ath10k_ct") == ("kmod-ath10k-ct",)
    assert suggest_packages("batctl_full") == ("batctl-full",)
    assert suggest_packages("rtl_433") == ()


@pytest.mark.parametrize(
    ("type_name", "expected"),
    [
        ("std_msgs/Boolean", "std_msgs/Bool"),
        ("sensor_msgs/msg/PointClouds2", "sensor_msgs/msg/PointCloud2"),
        ("nav_msgs/Odom", "nav_msgs/Odometry"),
        ("std_msgs/Qqqqqq", "a message of std_msgs"),
    ],
)
def test_the_nearest_message_is_offered(type_name: str, expected: str, tmp_path: Path) -> None:
    found = [one for one in _found(f"topics: {{commands: {{type: {type_name}}}}}", tmp_path) if one.code == "MC726"]
    assert [one.expected for one in found] == [expected]


def test_a_key_of_extra_uci_is_what_is_to_be_corrected_and_not_a_template(tmp_path: Path) -> None:
    """The finding said "Fix the template", of an inventory without one."""
    fragment = "nodes:\n  b01:\n    extra_uci:\n      wireless.guest.device: radio0\n"
    (finding,) = _found(fragment, tmp_path)
    expected = "create the section with a key of its own, `wireless.guest: TYPE`, or correct the name"
    assert (finding.code, finding.hint) == ("MC901", expected)
    lines = (tmp_path / "fleet.yaml").read_text(encoding="utf-8").splitlines()
    assert "wireless.guest.device" in lines[finding.position.line - 1]


def test_a_misspelled_package_of_extra_uci_is_found_where_its_section_is_created(tmp_path: Path) -> None:
    """Only the options below it were reported, as if their section were missing."""
    found = _found("nodes: {b01: {extra_uci: {wireles.guest: wifi-iface, sqm.wan: queue}}}", tmp_path)
    assert [(one.code, one.path, one.expected) for one in found] == [
        ("MC905", "nodes.b01.extra_uci.wireles.guest", "wireless")
    ]


def test_a_package_file_is_found_beside_the_included_file_that_names_it(tmp_path: Path) -> None:
    """It was looked for beside the inventory's first file: a false finding, and `provision` failed."""
    shared = (
        "hardware: {other: {board: a, profile: a, target: ath79/generic, release: '24.10', lan_ports: [], radios: {}, "
    )
    files = {
        "common/hardware.yaml": f"{shared}package_files: [../packages/tool.ipk]}}}}\n",
        "packages/tool.ipk": "package",
    }
    assert "MC811" not in {
        one.code for one in _found(Example("include: [common/hardware.yaml]", files=files), tmp_path)
    }


@pytest.mark.parametrize(
    ("name", "found"),
    [("wpad-mesh-mbedtls_2025.08.26~ca266cc2-r1_mips_24kc.ipk", False), ("tool (1).ipk", True), ("it's.ipk", True)],
)
def test_a_package_file_whose_name_cannot_be_sent_is_found(name: str, found: bool, tmp_path: Path) -> None:
    """`provision` ended with a traceback."""
    example = Example(f'hardware: {{rocket: {{package_files: ["{name}"]}}}}', files={name: "package"})
    assert ("MC811" in {one.code for one in _found(example, tmp_path)}) is found


def test_a_router_named_by_its_address_in_its_lan_is_a_radio(tmp_path: Path) -> None:
    robots = "robots: {base-station: {lan: {network: 10.43.0.0/24}, computer: {address: 10.43.0.10/24}}}"
    found = [one for one in _found(f"system: {{log_host: 10.43.0.1}}\n{robots}", tmp_path) if one.code == "MC235"]
    assert [(one.path, one.found) for one in found] == [("system.log_host", "10.43.0.1")]


def test_a_server_is_known_by_its_address_however_it_is_written(tmp_path: Path) -> None:
    robots = "robots: {base-station: {lan: {network: 'fd43::/64'}, computer: {address: 'fd43::10/64'}}}"
    computer = _found(f"system: {{log_host: 'fd43:0::10'}}\n{robots}", tmp_path)
    assert "MC234" not in {one.code for one in computer}
    radio = _found(f"system: {{log_host: 'fd43:0::1', ntp_servers: ['FD43::1']}}\n{robots}", tmp_path)
    assert [one.path for one in radio if one.code == "MC235"] == ["system.log_host", "system.ntp_servers.0"]
    port = "udp_mesh: {port: 5140}\nsystem: {log_host: 'fd43:0::10', log_port: 5140}\n"
    assert "MC737" in {one.code for one in _found(port + robots, tmp_path)}


@pytest.mark.parametrize("name", ["a b", "batctl-full=2024.3", "luci/app", ""])
def test_what_is_no_name_of_a_package_is_reported(name: str, tmp_path: Path) -> None:
    found = _found(
        f"hardware: {{rocket: {{packages: [kmod-batman-adv, batctl-default, iw, wpad-openssl, '{name}']}}}}", tmp_path
    )
    assert [(one.code, one.path) for one in found if one.code == "MC836"] == [("MC836", "hardware.rocket.packages.4")]


@pytest.mark.parametrize(
    ("driver", "expected"), [("kmod-ath9k", "ath9k"), ("mt76", "mt7601u, mt7603, mt7615e, mt7663u and 4 more")]
)
def test_packages_and_families_of_drivers_are_no_drivers(driver: str, expected: str, tmp_path: Path) -> None:
    found = _found(f"hardware: {{rocket: {{radios: {{radio0: {{driver: {driver}}}}}}}}}", tmp_path)
    assert [(one.code, one.expected) for one in found] == [("MC842", expected)]


@pytest.mark.parametrize("path", ["platform/ahb/1810000.wmac", "platform/ ahb/18100000.wmac", "platform/1030000.wmac"])
def test_a_mistyped_path_of_a_built_in_radio_is_reported(path: str, tmp_path: Path) -> None:
    found = _found(f"hardware: {{rocket: {{radios: {{radio0: {{path: '{path}'}}}}}}}}", tmp_path)
    assert [one.code for one in found if one.code in ("MC843", "MC834")] == ["MC843"]


def test_the_path_of_a_built_in_radio_tells_what_it_supports(tmp_path: Path) -> None:
    radios = "radios: {radio0: {path: platform/ahb/18100000.wmac}}"
    (finding,) = _found(f"meshes: {{main: {{htmode: HE20}}}}\nhardware: {{rocket: {{{radios}}}}}", tmp_path)
    assert finding.code == "MC844"
    assert finding.message.startswith("ath9k (radio0 of rocket) has no HE")


@pytest.mark.parametrize("key", ["label", "serial"])
def test_an_empty_label_or_serial_number_is_refused(key: str, tmp_path: Path) -> None:
    (finding,) = _found(f'nodes: {{b01: {{{key}: ""}}}}', tmp_path)
    assert (finding.code, finding.path, finding.expected) == ("INV021", f"nodes.b01.{key}", "text that is not empty")


@pytest.mark.parametrize(
    "host", ["http://pool.ntp.org", "pool.ntp,org", "10.42.0.100:123", "pool ntp org", "-pool.org"]
)
def test_what_is_no_host_is_no_time_server(host: str, tmp_path: Path) -> None:
    (finding,) = _found(f"system: {{ntp_servers: [10.42.0.100, '{host}']}}", tmp_path)
    assert (finding.code, finding.path, finding.found) == ("MC237", "system.ntp_servers.1", host)


@pytest.mark.parametrize("host", ["0.openwrt.pool.ntp.org", "fd42::1", "time_1", "pool.ntp.org."])
def test_hosts_are_time_servers(host: str, tmp_path: Path) -> None:
    assert "MC237" not in {one.code for one in _found(f"system: {{ntp_servers: [10.42.0.100, '{host}']}}", tmp_path)}


def test_a_single_value_in_place_of_a_list_is_explained(tmp_path: Path) -> None:
    (finding,) = _found("hardware: {rocket: {lan_ports: eth0}}", tmp_path)
    assert (finding.expected, finding.hint) == ("a list", "put it in brackets: `lan_ports: [...]`")


def test_typographic_quotes_are_found_at_their_place() -> None:
    text = 'meshes:\n  main: {ssid: \u201cfleet\u201d}\n  other: {ssid: "\u201ckept\u201d"}  # \u201cnot this\u201d\n'
    (finding,) = [one for one in lint_texts({"fleet.yaml": text}) if one.code == "MC005"]
    assert (finding.position.line, finding.position.column) == (2, 16)


def test_an_address_in_two_meshes_of_one_network_names_it_once(tmp_path: Path) -> None:
    second = """
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/24,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    nodes: {b01: {address: 10.99.0.1, radios: {radio1: {mesh: second, tx_power_dbm: 20}}}}
    """
    (finding,) = [one for one in _found(second, tmp_path) if one.code == "MC202"]
    assert finding.expected == "an address in 10.42.0.0/24"
