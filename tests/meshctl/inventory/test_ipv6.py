"""Inventories with IPv6 networks."""

from __future__ import annotations

from pathlib import Path

from tests.meshctl.inventory.inventories import HEAD, errors_of, fleet_of, load_text

_IPV6 = HEAD.replace("10.42.0.0/24", "fd42::/64")


def test_rules_count_ipv6_addresses_with_the_prefix_length_of_the_mesh(tmp_path: Path) -> None:
    nodes = 'nodes:\n  b[1-2]: {hardware: rocket, address: {rule: "fd42::100 + index"}}\n'
    fleet = load_text(tmp_path, _IPV6 + nodes).fleet
    assert fleet is not None
    assert [str(node.address) for node in fleet.nodes.values()] == ["fd42::101/64", "fd42::102/64"]


def test_an_address_with_a_zone_is_refused_and_belongs_under_ssh_host(tmp_path: Path) -> None:
    nodes = 'nodes: {b1: {hardware: rocket, address: "fe80::1%eth0"}}\n'
    assert any("`ssh.host`" in item.text for item in errors_of(tmp_path, nodes))
    nodes = 'nodes: {b1: {hardware: rocket, address: 10.42.0.1, ssh: {host: "fe80::1%eth0"}}}\n'
    assert fleet_of(tmp_path, nodes).nodes["b1"].ssh.host == "fe80::1%eth0"
