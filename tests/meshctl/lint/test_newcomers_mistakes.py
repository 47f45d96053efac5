"""Mistakes in a first inventory that were silent, in too many findings, or with advice that did not help."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.diagnostics import Diagnostic
from meshctl.lint import Example, check_path
from meshctl.lint.example import environment, write
from meshctl.regdb import SHIPPED, load

_REGDB = load(SHIPPED)
_THIN = "udp_mesh: {thin_links: {lora: {bits_per_s: 5470, band: BAND}}}\n"
_PORTS = """robots:
  base-station: {thin: {number: 1, ports: {lora: PORT}}}
  husky1: {thin: {number: 2, ports: {lora: /dev/ttyUSB0}}}
"""


def _found(fragment: str, directory: Path) -> list[Diagnostic]:
    example = Example(fragment)
    found = check_path(write(example, directory), _REGDB, environment(example)).diagnostics
    return [one for one in found if one.severity.value != "note"]


@pytest.mark.parametrize(("state", "codes"), [("spare", []), ("deployed", ["MC610"])])
def test_a_spare_radio_of_robots_belongs_to_no_robot_yet(state: str, codes: list[str], tmp_path: Path) -> None:
    fragment = f"nodes: {{spare1: {{role: robot, state: {state}, hardware: rocket, address: 10.42.0.77}}}}"
    assert [one.code for one in _found(fragment, tmp_path)] == codes


@pytest.mark.parametrize(
    ("fragment", "code", "path"),
    [
        ("system: {log_host: 10.42.0.300}", "MC237", "system.log_host"),
        ("system: {ntp_servers: [10.42.0, 5]}", "MC237", "system.ntp_servers.0"),
        ("robots: {husky1: {computer: {ssh: {host: 10.42.0.300}}}}", "MC435", "robots.husky1.computer.ssh.host"),
        ("robots: {husky1: {computer: {ssh: {jump: bsae}}}}", "MC105", "robots.husky1.computer.ssh.jump"),
        ("nodes: {b01: {packages: [kmod-nft-brige]}}", "MC832", "nodes.b01.packages.0"),
        ("nodes: {b01: {packages: [batman-adv]}}", "MC832", "nodes.b01.packages.0"),
        (
            _THIN.replace("BAND", "eu868") + _PORTS.replace("PORT", "/dev/ttyUSB1"),
            "MC781",
            "udp_mesh.thin_links.lora.band",
        ),
        (
            "nodes: {b02: {state: lost, address: 10.42.0.78}, b01: {gateway: 10.42.0.78}}",
            "MC223",
            "nodes.b01.gateway",
        ),
    ],
)
def test_what_was_silent_is_reported(fragment: str, code: str, path: str, tmp_path: Path) -> None:
    assert (code, path) in {(one.code, one.path) for one in _found(fragment, tmp_path)}


@pytest.mark.parametrize("port", ["COM3", "ttyUSB0", "''", "'/dev/tty USB0'"])
def test_a_serial_port_is_a_path(port: str, tmp_path: Path) -> None:
    (finding,) = _found(_THIN.replace("BAND", "us915") + _PORTS.replace("PORT", port), tmp_path)
    assert (finding.code, finding.path) == ("INV021", "robots.base-station.thin.ports.lora")
    assert finding.expected == "the path of a serial port such as /dev/ttyUSB0 or /dev/serial/by-id/..."


@pytest.mark.parametrize(("country", "band"), [("DE", "eu868"), ("US", "us915"), ("JP", "eu868"), ("US", "none")])
def test_a_band_of_the_country_is_sound(country: str, band: str, tmp_path: Path) -> None:
    fragment = f"country: {country}\n" + _THIN.replace("BAND", band) + _PORTS.replace("PORT", "/dev/ttyUSB1")
    assert "MC781" not in {one.code for one in _found(fragment, tmp_path)}


def test_the_own_address_as_gateway_is_named(tmp_path: Path) -> None:
    """It said `not reachable from the node`, of its own address."""
    (finding,) = _found("nodes: {b01: {address: 10.42.0.77, gateway: 10.42.0.77}}", tmp_path)
    assert (finding.code, finding.message) == ("MC204", "it is the node's own address")
    assert finding.hint.startswith("Write `gateway: null`")


def test_a_wrong_network_is_one_finding(tmp_path: Path) -> None:
    """Each node and computer outside had its own, unless all nodes were outside."""
    fragment = """
    meshes: {main: {network: 10.77.0.0/24}}
    nodes: {"c[1-2]": {hardware: rocket, address: {rule: network + 200 + index}}}
    """
    found = [one for one in _found(fragment, tmp_path) if one.code in ("MC202", "MC209", "MC212", "MC213", "MC221")]
    assert [(one.code, one.path) for one in found] == [("MC202", "meshes.main.network")]


def test_a_range_that_overlaps_another_is_one_finding(tmp_path: Path) -> None:
    fragment = """
    nodes:
      "c[1-4]": {hardware: rocket, address: {from: 10.42.0.201}}
      "d[1-4]": {hardware: rocket, address: {from: 10.42.0.203}}
    """
    (finding,) = [one for one in _found(fragment, tmp_path) if one.code == "MC201"]
    assert (finding.path, finding.message) == ("nodes.d1.address", "d1, d2 have the addresses of c3, c4")


def test_a_range_outside_the_network_is_one_finding(tmp_path: Path) -> None:
    fragment = 'nodes: {"c[1-2]": {hardware: rocket, address: {from: 10.42.1.10}}}'
    (finding,) = [one for one in _found(fragment, tmp_path) if one.code == "MC202"]
    assert finding.message == "c1, c2 are outside their mesh's network"


def test_thin_links_that_are_not_defined_are_one_finding(tmp_path: Path) -> None:
    (finding,) = [one for one in _found(_PORTS.replace("PORT", "/dev/ttyUSB1"), tmp_path) if one.code == "MC772"]
    assert finding.message == "no thin link is defined"


@pytest.mark.parametrize(
    ("carries", "hint"),
    [
        ("beacons", "a group: list its nodes (c1, c2), or a range of them"),
        ("c*", 'patterns are for commands: list the nodes, or a range such as "b[01-03]"'),
    ],
)
def test_a_group_or_a_pattern_is_not_what_a_robot_carries(carries: str, hint: str, tmp_path: Path) -> None:
    fragment = f"""
    groups: {{beacons: {{state: carried}}}}
    nodes: {{"c[1-2]": {{hardware: rocket, groups: [beacons], address: {{from: 10.42.0.201}}}}}}
    robots: {{husky1: {{carries: ["{carries}"]}}}}
    """
    assert [one.hint for one in _found(fragment, tmp_path) if one.code == "MC104"] == [hint]


def test_a_radio_of_another_band_is_the_reason_for_no_mesh(tmp_path: Path) -> None:
    found = _found("meshes: {main: {band: 5g, channel: 36}}", tmp_path)
    assert {one.found for one in found if one.code in ("MC108", "MC619")} <= {
        "none: radio0 is 2g, and mesh main is 5g",
        "none",
    }


def test_a_label_is_shown_as_written(tmp_path: Path) -> None:
    found = _found("nodes: {b01: {label: Box}, base: {label: BOX}}", tmp_path)
    assert [(one.path, one.found) for one in found if one.code == "MC116"] == [("nodes.b01.label", "Box")]


_ROBOTS = "".join(
    f"  r{number}: {{nodes: [r{number}-radio], computer: {{address: 10.42.0.{150 + number}/24, ssh: {{user: r}}}}}}\n"
    for number in range(1, 6)
)


def test_radios_under_another_name_are_one_finding(tmp_path: Path) -> None:
    nodes = 'nodes: {"r[1-5]_radio": {role: robot, hardware: rocket, address: {from: 10.42.0.201}}}\nrobots:\n'
    found = _found(nodes + _ROBOTS, tmp_path)
    (unknown,) = [one for one in found if one.code == "MC103"]
    assert unknown.message == "no such nodes (also of r2, r3, r4, r5)"
    (hostname,) = [one for one in found if one.code == "MC111"]
    assert (hostname.path, hostname.message) == ("nodes.r1_radio.hostname", "invalid hostnames")


def test_a_network_with_another_prefix_than_all_computers_is_one_finding(tmp_path: Path) -> None:
    nodes = 'nodes: {"r[1-5]-radio": {role: robot, hardware: rocket, address: {from: 10.42.0.201}}}\nrobots:\n'
    found = _found("meshes: {main: {network: 10.42.0.0/23}}\n" + nodes + _ROBOTS, tmp_path)
    assert [(one.path, one.expected, one.found) for one in found if one.code == "MC210"] == [
        ("meshes.main.network", "/24", "/23")
    ]


@pytest.mark.parametrize("key", ["log_host: base-station", "ntp_servers: [base-station]"])
def test_a_name_of_the_inventory_is_no_host_name(key: str, tmp_path: Path) -> None:
    fragment = f"system: {{{key}}}\nnodes: {{b01: {{gateway: 10.42.0.254}}}}"
    (finding,) = [one for one in _found(fragment, tmp_path) if one.code == "MC235"]
    assert (finding.expected, finding.found) == ("10.42.0.100", "base-station")


def _gateways(nodes: str, directory: Path) -> list[tuple[str, str]]:
    example = Example(nodes)
    found = check_path(write(example, directory), _REGDB, environment(example)).diagnostics
    return [(one.path, one.message) for one in found if one.code == "MC225"]


@pytest.mark.parametrize("gateway", ["10.42.0.100", "10.42.0.1"])
def test_a_gateway_in_the_inventory_is_known(gateway: str, tmp_path: Path) -> None:
    assert _gateways(f"nodes: {{b01: {{gateway: {gateway}}}}}", tmp_path) == []


def test_an_unknown_gateway_is_one_note_for_all_its_nodes(tmp_path: Path) -> None:
    message = "base, husky1-front, b01: no station in the inventory has this address"
    assert _gateways("defaults: {gateway: 10.42.0.254}", tmp_path) == [("nodes.base.gateway", message)]
    # MC204 and MC223 report these
    (tmp_path / "other").mkdir()
    nodes = "nodes: {b01: {gateway: 10.99.0.1}, husky1-front: {gateway: 10.42.0.1}, base: {state: lost}}"
    assert _gateways(nodes, tmp_path / "other") == []


_ROW = "".join(f"  a{number}: {{position: {{x_m: {number * 900}, y_m: 0}}}}\n" for number in range(1, 5))
_IN_A_ROW = 'nodes:\n  "a[1-4]": {role: beacon, hardware: rocket, address: {from: 10.42.0.201}}\n' + _ROW


@pytest.mark.parametrize(
    ("more", "path"),
    [
        ("  b01: {position: {x_m: 4500, y_m: 0}}\n", None),
        # two nodes without a position may stand between them
        ("  b01: {position: {x_m: 6500, y_m: 0}}\n", None),
        ("  b01: {position: {x_m: 6700, y_m: 0}}\n", "meshes.main.distance_m"),
        ("  b01: {position: {x_m: 44000, y_m: 0}}\n", "nodes.b01.position"),
        ("  b01: {position: {x_m: 300000, y_m: 0}}\n", None),
        ("meshes: {main: {distance_m: 0}}\n", None),
        ("meshes: {main: {distance_m: 200}}\n", "meshes.main.distance_m"),
    ],
)
def test_nodes_that_are_farther_apart_than_the_longest_link(more: str, path: str | None, tmp_path: Path) -> None:
    found = [one.path for one in _found(_IN_A_ROW + more, tmp_path) if one.code == "MC643"]
    assert found == ([] if path is None else [path])


@pytest.mark.parametrize(
    ("path", "codes"),
    [
        ("pci0000:00/0000:00:00", ["MC843"]),
        ("pci0000:00", ["MC843"]),
        ("1e140000.pcie/pci0000:00/0000:00:01.0/0000:02:00", ["MC843"]),
        ("pci0000:00/0000:00:00.0", []),
        ("pci0000:00/0000:00:00.0/usb1/1-1/1-1:1.0", []),
    ],
)
def test_a_pci_device_has_a_function(path: str, codes: list[str], tmp_path: Path) -> None:
    found = _found(f"hardware: {{rocket: {{radios: {{radio0: {{path: '{path}'}}}}}}}}", tmp_path)
    assert [one.code for one in found if one.code == "MC843"] == codes


def test_overlapping_networks_of_two_meshes_are_one_finding(tmp_path: Path) -> None:
    """Each node's prefix (MC215) and gateway (MC204) were reported, too."""
    fragment = """
    meshes:
      second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 5g, channel: 149, network: 10.42.0.0/23,
               encryption: psk2+ccmp, key: {env: MESH_KEY}}
    defaults: {gateway: 10.42.1.254}
    nodes: {base: {radios: {radio1: {mesh: second}}}, husky1-front: {address: 10.42.0.11/23}}
    """
    found = [one.code for one in _found(fragment, tmp_path) if one.code.startswith("MC2")]
    assert (found.count("MC205"), {"MC204", "MC215"} & {*found}) == (1, set())


def test_radios_with_the_names_of_robots_are_one_finding(tmp_path: Path) -> None:
    nodes = 'nodes: {"r[1-5]-radio": {role: robot, hardware: rocket, address: {from: 10.42.0.201}}, '
    nodes += '"r[1-5]": {role: beacon, hardware: rocket, address: {from: 10.42.0.211}}}\nrobots:\n'
    (finding,) = [one for one in _found(nodes + _ROBOTS, tmp_path) if one.code == "MC120"]
    assert (finding.path, finding.found) == ("robots.r1", "r1, r2, r3, r4 and 1 more")


@pytest.mark.parametrize(
    ("path", "target"),
    [
        ("1e140000.pcie/pci0000:00/0000:00:01.0/0000:02:00.0", "ramips/mt7621"),
        ("1a143000.pcie/pci0000:00/0000:00:00.0/0000:01:00.0", "mediatek/mt7622"),
        ("soc/40000000.pci/pci0000:00/0000:00:00.0/0000:01:00.0", "ipq40xx/generic"),
        ("soc/1b500000.pci/pci0000:00/0000:00:00.0/0000:01:00.0", "ipq806x/generic"),
        ("pci0000:00/0000:00:00.0", ""),
    ],
)
def test_the_controller_of_a_pci_radio_tells_the_chip(path: str, target: str, tmp_path: Path) -> None:
    fragment = f"hardware: {{rocket: {{radios: {{radio0: {{path: '{path}'}}}}}}}}"
    found = [one for one in _found(fragment, tmp_path) if one.code == "MC834"]
    assert [one.expected for one in found] == ([f"{target.partition('/')[0]}/..."] if target else [])
    (tmp_path / "right").mkdir()
    right = fragment.replace("radios:", f"target: {target or 'ath79/generic'}, radios:")
    assert [one for one in _found(right, tmp_path / "right") if one.code == "MC834"] == []


def test_a_network_that_is_too_small_for_a_range_is_one_finding(tmp_path: Path) -> None:
    """Addresses that end in 0 and 255 outside the network were reported, too."""
    fragment = """
    meshes: {main: {network: 10.42.0.0/25}}
    nodes: {"n[001-200]": {address: {from: 10.42.0.120}}}
    """
    found = [one for one in _found(fragment, tmp_path) if one.code in ("MC202", "MC203")]
    assert [(one.code, one.path) for one in found] == [("MC202", "meshes.main.network")]
    assert found[0].expected == "a network with 10.42.0.128 to 10.42.1.63, such as 10.42.0.0/23"


def test_two_robots_with_one_lan_are_one_finding(tmp_path: Path) -> None:
    """The routers' and the computers' addresses, which are equal because the LANs are, were reported, too."""
    fragment = """
    nodes: {husky2-front: {role: robot, address: 10.42.0.12}}
    robots:
      base-station: {computer: {gateway: 10.42.0.1}}
      husky1: {lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24}}
      husky2: {nodes: [husky2-front], lan: {network: 10.43.1.0/24}, computer: {address: 10.43.1.10/24}}
    """
    found = [one for one in _found(fragment, tmp_path) if one.code in ("MC201", "MC216")]
    assert [(one.code, one.path) for one in found] == [("MC216", "robots.husky2.lan.network")]


def test_a_board_without_its_vendor_is_reported_at_the_board(tmp_path: Path) -> None:
    """The profile was expected to be `tl-wr841n-v9`."""
    names = "board: tl-wr841-v9, profile: tplink_tl-wr841-v9"
    (finding,) = [one for one in _found(f"hardware: {{rocket: {{{names}}}}}", tmp_path) if one.code == "MC825"]
    assert (finding.path, finding.expected) == ("hardware.rocket.board", "tplink,tl-wr841-v9")
