"""What an inventory means."""

from __future__ import annotations

import os
from ipaddress import IPv4Interface
from pathlib import Path

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.firmware import image_path
from meshctl.inventory import load, load_fleet
from meshctl.inventory.file_paths import file_path, known_hosts_path
from meshctl.model import Band, NodeState, Release, Role, SecretKind
from tests.meshctl.inventory.inventories import HEAD, fleet_of, load_text


def test_scalars_are_interpreted_by_field_type_and_not_by_yaml_rules(tmp_path: Path) -> None:
    text = HEAD.replace("country: US", "country: NO").replace("release: 23.05", "release: 24.10")
    loaded = load_text(
        tmp_path,
        text
        + "nodes:\n  n: {hardware: rocket, address: 10.42.0.1, mac: 12:34:56:12:34:56, serial: 0123, label: 1e3}\n",
    )
    assert loaded.fleet is not None
    node = loaded.fleet.nodes["n"]
    assert loaded.fleet.country == "NO"
    assert node.release is Release.V24_10
    assert (node.mac, node.serial, node.label) == ("12:34:56:12:34:56", "0123", "1e3")


def test_a_label_in_a_block_has_no_line_break_at_its_end(tmp_path: Path) -> None:
    fleet = fleet_of(
        tmp_path, "nodes:\n  n:\n    hardware: rocket\n    address: 10.42.0.1\n    label: |\n      left lid\n"
    )
    assert fleet.nodes["n"].label == "left lid"


def test_a_range_expands_in_order_with_consecutive_addresses(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, "nodes: {'b[08-11]': {hardware: rocket, address: {from: 10.42.0.101}}}\n")
    assert [(name, str(node.address)) for name, node in fleet.nodes.items()] == [
        ("b08", "10.42.0.101/24"),
        ("b09", "10.42.0.102/24"),
        ("b10", "10.42.0.103/24"),
        ("b11", "10.42.0.104/24"),
    ]


def test_a_range_in_a_plain_key_needs_no_quotes(tmp_path: Path) -> None:
    fleet = fleet_of(
        tmp_path,
        """\
        nodes:
          b[1,3]-x[a,b]: {hardware: rocket, address: {from: 10.42.0.1}}
        """,
    )
    assert list(fleet.nodes) == ["b1-xa", "b1-xb", "b3-xa", "b3-xb"]


def test_a_nodes_own_entry_overrides_its_range_in_either_order(tmp_path: Path) -> None:
    own = "  b02: {state: lost, label: broken}\n"
    ranged = "  b[01-03]: {hardware: rocket, state: carried, address: {from: 10.42.0.101}}\n"
    for entries in (own + ranged, ranged + own):
        fleet = fleet_of(tmp_path, "nodes:\n" + entries)
        assert {name: node.state.value for name, node in fleet.nodes.items()} == {
            "b01": "carried",
            "b02": "lost",
            "b03": "carried",
        }
        assert fleet.nodes["b02"].label == "broken"
        assert str(fleet.nodes["b02"].address) == "10.42.0.102/24"


def test_an_explicit_address_does_not_shift_the_addresses_of_other_nodes(tmp_path: Path) -> None:
    text = """\
        groups: {g: {hardware: rocket, address: {rule: network + 50 + 2 * index}}}
        nodes:
          a: {groups: [g]}
          b: {groups: [g], address: 10.42.0.200}
          c: {groups: [g]}
        """
    fleet = fleet_of(tmp_path, text)
    assert [str(node.address.ip) for node in fleet.nodes.values()] == ["10.42.0.52", "10.42.0.200", "10.42.0.56"]


def test_an_address_without_a_prefix_takes_it_from_the_mesh(tmp_path: Path) -> None:
    text = "nodes: {a: {hardware: rocket, address: 10.42.0.1}, b: {hardware: rocket, address: 10.42.0.2/16}}\n"
    fleet = fleet_of(tmp_path, text)
    assert fleet.nodes["a"].address == IPv4Interface("10.42.0.1/24")
    assert fleet.nodes["b"].address == IPv4Interface("10.42.0.2/16")


def test_a_radio_joins_the_only_mesh_of_its_band_unless_mesh_is_null(tmp_path: Path) -> None:
    text = """\
        nodes:
          on: {hardware: rocket, address: 10.42.0.1}
          off: {hardware: rocket, address: 10.42.0.2, radios: {radio0: {mesh: null}}}
        """
    fleet = fleet_of(tmp_path, text)
    assert fleet.nodes["on"].meshes == ("main",)
    assert fleet.nodes["off"].meshes == ()
    assert fleet.nodes["off"].address == IPv4Interface("10.42.0.2/24")
    assert fleet.nodes["on"].radios[0].tx_power_dbm == 28


def test_with_two_meshes_in_a_band_a_radio_joins_none_by_itself(tmp_path: Path) -> None:
    text = HEAD.replace(
        "meshes:\n",
        "meshes:\n  other: {ssid: o, band: 2g, channel: 11, network: 10.43.0.0/24}\n"
        "  fast: {ssid: f, band: 5g, channel: 149, network: 10.44.0.0/16}\n",
    )
    node = "nodes:\n  a: {hardware: rocket, address: 10.43.0.9, radios: {radio0: {mesh: other}}}\n"
    node += "  b: {hardware: rocket, address: 10.44.0.9}\n"
    loaded = load_text(tmp_path, text + node)
    assert loaded.fleet is not None
    assert loaded.fleet.nodes["a"].meshes == ("other",)
    assert loaded.fleet.nodes["b"].meshes == ()
    assert str(loaded.fleet.nodes["b"].address) == "10.44.0.9/16"
    assert loaded.fleet.meshes["fast"].band is Band.G5


def test_nodes_override_groups_override_defaults_and_mappings_are_merged(tmp_path: Path) -> None:
    text = """\
        defaults: {hardware: rocket, state: spare, role: beacon, ssh: {port: 2222, user: admin}}
        groups:
          low: {state: carried, radios: {radio0: {tx_power_dbm: 10, mac: 02:00:00:00:00:01}}}
          high: {inherits: [low], radios: {radio0: {tx_power_dbm: 20}}}
        nodes:
          n: {groups: [high], address: 10.42.0.1, ssh: {user: root}}
        """
    node = fleet_of(tmp_path, text).nodes["n"]
    assert (node.state, node.role) == (NodeState.CARRIED, Role.BEACON)
    assert (node.ssh.port, node.ssh.user) == (2222, "root")
    assert (node.radios[0].tx_power_dbm, node.radios[0].mac) == (20, "02:00:00:00:00:01")


def test_nodes_listed_by_a_robot_belong_to_it_unless_assigned_elsewhere(tmp_path: Path) -> None:
    text = """\
        nodes:
          r: {hardware: rocket, address: 10.42.0.1}
          b[1-2]: {hardware: rocket, address: {from: 10.42.0.11}}
          c: {hardware: rocket, address: 10.42.0.9, robot: elsewhere}
        robots:
          husky: {nodes: [r], carries: ["b[1-2]", c]}
        """
    fleet = fleet_of(tmp_path, text)
    assert {name: node.robot for name, node in fleet.nodes.items()} == {
        "r": "husky",
        "b1": "husky",
        "b2": "husky",
        "c": "elsewhere",
    }
    assert fleet.robots["husky"].carries == ("b1", "b2", "c")
    assert fleet.where("nodes", "b1", "robot").layer == "robot husky"


def test_includes_add_sections_and_entries_and_keep_their_own_directory(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "mesh.yaml").write_text(
        "meshctl: 1\nmeshes:\n  second:\n    ssid: s\n    band: 5g\n    channel: 149\n    network: 10.9.0.0/24\n"
        "    encryption: sae\n    key: {file: k.yaml, key: mesh}\n"
        "include: [topics.yaml]\n"
    )
    (tmp_path / "sub" / "topics.yaml").write_text("topics: {stop: {priority: 0, class: emergency_stop}}\n")
    fleet = fleet_of(tmp_path, "include: [sub/mesh.yaml]\ntopics: {chat: {priority: 4}}\n")
    assert list(fleet.meshes) == ["main", "second"]
    assert [topic.name for topic in fleet.topics] == ["chat", "stop"]
    assert [Path(file).name for file in fleet.files] == ["fleet.yaml", "mesh.yaml", "topics.yaml"]
    key = fleet.meshes["second"].key
    assert key is not None
    assert (key.kind, key.where, key.key, key.base) == (SecretKind.FILE, "k.yaml", "mesh", str(tmp_path / "sub"))
    assert fleet.base == str(tmp_path)


def test_an_include_below_home_follows_the_given_environment(tmp_path: Path) -> None:
    home, inventory = tmp_path / "home", tmp_path / "fleet"
    home.mkdir()
    inventory.mkdir()
    (home / "t.yaml").write_text("topics: {chat: {priority: 4}}\n")
    (inventory / "fleet.yaml").write_text(HEAD + "include: [~/t.yaml]\n")
    loaded = load(inventory, environ={"HOME": str(home), "MESHCTL_INCLUDE_PATH": str(home)})
    assert loaded.fleet is not None
    refused = load(inventory, environ={"HOME": str(home)}).diagnostics[0]
    assert refused.code == "INV010"
    assert refused.hint == "move it there, or allow its directory: export MESHCTL_INCLUDE_PATH=DIR"
    assert load(inventory).diagnostics[0].code == "INV010"


def test_includes_outside_the_tree_and_special_files_are_rejected_unread(tmp_path: Path) -> None:
    inventory = tmp_path / "fleet"
    inventory.mkdir()
    (tmp_path / "token.yaml").write_text("HUNTER2: secret\n")
    (inventory / "link.yaml").symlink_to(tmp_path / "token.yaml")
    os.mkfifo(inventory / "pipe.yaml")
    for name in ("../token.yaml", "link.yaml", "pipe.yaml", "/dev/zero", str(tmp_path / "token.yaml")):
        (inventory / "fleet.yaml").write_text(HEAD + f"include: [{name}]\n")
        (found,) = load(inventory).diagnostics
        assert (found.code, found.position.file) == ("INV010", str(inventory / "fleet.yaml")), name
        assert "HUNTER2" not in str(found)
    (tmp_path / ".git").mkdir()
    (inventory / "fleet.yaml").write_text(HEAD + "include: [../token.yaml]\n")
    assert load(inventory).diagnostics[0].code == "INV020", "in the same work tree it is read"


def test_aliases_byte_order_marks_and_crlf_are_supported(tmp_path: Path) -> None:
    text = HEAD + "groups:\n  a: {radios: &r {radio0: {tx_power_dbm: 11}}}\nnodes:\n"
    text += "  n: {hardware: rocket, address: 10.42.0.1, radios: *r}\n"
    (tmp_path / "fleet.yaml").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    fleet = load_fleet(tmp_path / "fleet.yaml")
    assert fleet.nodes["n"].radios[0].tx_power_dbm == 11
    assert fleet.where("fleet").position.line == 2


def test_empty_nodes_and_sections_are_read_as_empty_mappings(tmp_path: Path) -> None:
    text = "defaults: {hardware: rocket, address: {rule: network + index}}\nnodes:\n  a:\n  b:\ntopics:\ngroups:\n"
    fleet = fleet_of(tmp_path, text)
    assert [str(node.address.ip) for node in fleet.nodes.values()] == ["10.42.0.1", "10.42.0.2"]


def test_a_computer_has_no_root_login_by_default(tmp_path: Path) -> None:
    text = "nodes: {n: {hardware: rocket, address: 10.42.0.1}}\nrobots: {r: {computer: {address: 10.42.0.2/24}}}\n"
    fleet = fleet_of(tmp_path, text)
    computer = fleet.robots["r"].computer
    assert computer is not None
    assert computer.ssh.user == ""
    assert fleet.nodes["n"].ssh.user == "root"


def test_load_fleet_raises_every_diagnostic_at_once(tmp_path: Path) -> None:
    (tmp_path / "fleet.yaml").write_text("meshctl: 1\ncuntry: US\n")
    with pytest.raises(InvalidInput) as caught:
        load_fleet(tmp_path)
    assert [item.code for item in caught.value.diagnostics] == ["INV022", "INV020"]


def test_loading_twice_gives_the_same_fleet(tmp_path: Path) -> None:
    text = "nodes: {'b[1-3]': {hardware: rocket, address: {from: 10.42.0.1}}}\n"
    first, second = fleet_of(tmp_path, text), fleet_of(tmp_path, text)
    assert first.nodes == second.nodes
    assert dict(first.provenance) == dict(second.provenance)


def test_a_radio_of_an_unknown_mesh_is_refused_where_it_is_named_and_left_to_lint(tmp_path: Path) -> None:
    loaded = load_text(
        tmp_path,
        HEAD + "groups:\n  g: {hardware: rocket, radios: {radio0: {mesh: mian}}}\n"
        "nodes: {'b[1-3]': {groups: [g], address: {from: 10.42.0.1}}}\n",
    )
    assert loaded.fleet is not None, "lint has a fleet to check"
    with pytest.raises(InvalidInput) as caught:
        load_fleet(tmp_path)
    (found,) = caught.value.diagnostics
    line = (tmp_path / "fleet.yaml").read_text().splitlines()[found.position.line - 1]
    assert (found.code, found.message, found.hint) == ("INV037", "unknown mesh 'mian'", "did you mean 'main'?")
    assert "mesh: mian" in line


def test_every_path_is_relative_to_the_file_that_names_it(tmp_path: Path) -> None:
    """Profiles and logins in included files named files beside the first one, against the documentation."""
    (tmp_path / "inventory").mkdir()
    (tmp_path / "common").mkdir()
    head, _, hardware = HEAD.partition("hardware:")
    (tmp_path / "inventory" / "fleet.yaml").write_text(
        f"{head}include: [../common/shared.yaml, {tmp_path}/common/absolute.yaml]\n"
        "nodes: {n: {groups: [own], address: 10.42.0.1}, m: {address: 10.42.0.2, ssh: {key_files: [id_m]}}}\n"
    )
    (tmp_path / "common" / "shared.yaml").write_text(
        f"hardware:{hardware}    package_files: [tool.ipk, /srv/other.ipk, ~/home.ipk]\n"
        "    firmware: {image: rocket.bin}\n"
        "operators: {known_hosts: pins}\n"
        "defaults: {hardware: rocket, ssh: {key_files: [id]}}\n"
        "groups: {own: {ssh: {key_files: [keys/own]}}}\n"
        "sites: {north: {ssh: {host: gw.example, key_files: [id_site]}}}\n"
        "robots: {r: {computer: {address: 10.42.0.9/24, ssh: {key_files: [id_robot]}}}}\n"
    )
    (tmp_path / "common" / "absolute.yaml").write_text(
        "nats: {url: 'tls://nats.example:4222', credentials: operator.creds, ca: ca.pem}\n"
    )
    environ = {"MESHCTL_INCLUDE_PATH": str(tmp_path)}
    fleet = load_fleet(tmp_path / "inventory", environ=environ)
    computer, nats = fleet.robots["r"].computer, fleet.nats
    assert computer is not None
    assert nats is not None
    common = tmp_path / "inventory" / ".." / "common"
    profile = fleet.hardware["rocket"]
    assert [file_path(fleet, file) for file in profile.package_files] == [
        common / "tool.ipk",
        Path("/srv/other.ipk"),
        Path("~/home.ipk").expanduser(),
    ]
    assert image_path(profile) == common / "rocket.bin"
    assert known_hosts_path(fleet) == common / "pins"
    logins = [fleet.nodes["n"].ssh, fleet.nodes["m"].ssh, fleet.sites["north"].ssh, computer.ssh]
    assert [file_path(fleet, *ssh.key_files) for ssh in logins] == [
        common / "keys" / "own",
        tmp_path / "inventory" / "id_m",
        common / "id_site",
        common / "id_robot",
    ]
    assert [file_path(fleet, text) for text in (nats.credentials, nats.ca)] == [
        tmp_path / "common" / "operator.creds",
        tmp_path / "common" / "ca.pem",
    ]


def test_known_hosts_are_beside_the_first_file_unless_set(tmp_path: Path) -> None:
    (tmp_path / "common").mkdir()
    (tmp_path / "common" / "operators.yaml").write_text("operators: {password_login: true}\n")
    fleet = fleet_of(tmp_path, "include: [common/operators.yaml]\n")
    assert known_hosts_path(fleet) == tmp_path / "known_hosts"
