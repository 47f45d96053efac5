"""Inventories with IPv6 networks."""

from __future__ import annotations

from pathlib import Path

import pytest

from meshctl.model import Secret
from meshctl.render import Templates, render_node
from meshlab.errors import LabError
from meshlab.from_inventory import spec_of
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


_NODE = """
operators: {ssh_keys: ["ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIGxvb25zIGFyZSBhcXVhdGljIGJpcmRz bob"]}
nodes: {b1: {hardware: rocket, address: "fd42::11", gateway: "fd42::1"}}
"""


def test_a_node_gets_its_ipv6_address_prefix_and_gateway_and_no_ipv4_options(tmp_path: Path) -> None:
    fleet = load_text(tmp_path, _IPV6 + _NODE).fleet
    assert fleet is not None
    rendered = render_node(fleet, "b1", lambda _: Secret(""), Templates.of(fleet))
    network = rendered.package("network")
    lan = None if network is None else network.section("lan")
    assert lan is not None
    assert lan.get("ip6addr") == "fd42::11/64"
    assert lan.get("ip6gw") == "fd42::1"
    assert not {"ipaddr", "netmask", "gateway"} & set(lan.options)


def test_the_virtual_fleet_refuses_an_ipv6_inventory_and_names_the_node(tmp_path: Path) -> None:
    fleet = load_text(tmp_path, _IPV6 + _NODE).fleet
    assert fleet is not None
    with pytest.raises(LabError, match=r"node b1 has the IPv6 address fd42::11: the virtual fleet has IPv4 only"):
        spec_of(fleet)
