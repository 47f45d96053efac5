"""Render -> import: a node that meshctl configured comes back as an equal entry, for every example inventory."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from meshctl.interchange.device_entries import ImportOptions
from meshctl.interchange.device_import import DeviceImport, import_device
from meshctl.interchange.new_inventory import edited
from meshctl.inventory import load_fleet
from meshctl.inventory.edit import save
from meshctl.model import Fleet, Node
from meshctl.render import Templates, render_node
from meshctl.render.compare import placeholder_secret
from meshctl.resources import shipped
from tests.meshctl.interchange.devices import SSH_KEY, new_inventory, rendered_device
from tests.meshctl.render import fleets
from tests.meshctl.render.golden import cases

CASES = dict(cases())
EXAMPLES = sorted(path.parent.name for path in shipped("inventory").glob("*/fleet.yaml"))


def with_key(fleet: Fleet) -> Fleet:
    """The starter has no operator's key yet."""
    keys = fleet.operators.ssh_keys or (SSH_KEY,)
    return replace(fleet, operators=replace(fleet.operators, ssh_keys=keys))


def is_elsewhere(key: str) -> bool:
    """Routes to other robots' LANs come back with the entries of those robots; a LAN filter's exceptions are in a
    script, which import does not read."""
    return key.startswith(("network.@route", "firewall.lan_filter"))


def first_of_each_kind(fleet: Fleet) -> list[Node]:
    """Nodes that differ in more than name and address."""
    kinds: dict[object, Node] = {}
    for node in fleet.managed():
        kinds.setdefault((node.hardware.name, node.role, node.meshes, node.lan_address is None, node.gateway), node)
    return list(kinds.values())


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_new_inventory_renders_what_is_on_the_device(name: str, tmp_path: Path) -> None:
    fleet = with_key(load_fleet(shipped("inventory") / name))
    for node in first_of_each_kind(fleet):
        files = render_node(fleet, node.name, placeholder_secret, Templates.of(fleet))
        made = new_inventory(rendered_device(fleet, node, files), tmp_path)
        assert made.kept == {}, node.name
        assert [each.line for each in made.differences if not is_elsewhere(each.key)] == [], node.name
        assert made.untouched == (("meshmerize",) if name == "mine" else ()), node.name
        entry = made.fleet.nodes[made.name]
        assert (entry.name, entry.hostname, entry.label) == (node.name, node.hostname, node.label)
        assert (entry.address, entry.gateway, entry.release) == (node.address, node.gateway, node.release)
        assert (entry.lan_address, entry.lan_ports) == (node.lan_address, node.lan_ports)
        assert [(r.name, r.tx_power_dbm) for r in entry.radios] == [(r.name, r.tx_power_dbm) for r in node.radios]


@pytest.mark.parametrize("name", CASES)
def test_every_release_back_end_and_mode_comes_back(name: str, tmp_path: Path) -> None:
    fleet = CASES[name]
    node = next(iter(fleet.nodes.values()))
    files = render_node(fleet, node.name, fleets.secrets)
    made = new_inventory(rendered_device(fleet, node, files), tmp_path)
    assert [each.line for each in made.differences if not is_elsewhere(each.key)] == []
    assert made.kept == {}
    assert [key.reveal() for key in made.secrets.values()] == [fleets.KEY] * len(made.secrets)
    assert len(made.secrets) == sum(mesh.key is not None for mesh in fleet.meshes.values() if mesh.name in node.meshes)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_inventory_gets_an_equal_entry_back(name: str, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(shipped("inventory") / name, tmp_path / "fleet"))
    if not load_fleet(copy).operators.ssh_keys:
        save(edited(copy, {}, {("operators", "ssh_keys"): [SSH_KEY]}).changes())
    fleet = load_fleet(copy)
    for node in first_of_each_kind(fleet):
        files = render_node(fleet, node.name, placeholder_secret, Templates.of(fleet))
        made = imported(copy, fleet, rendered_device(fleet, node, files), again(node))
        entry = made.fleet.nodes["again"]
        if node.lan_address is not None:
            # a router is one by its robot, which has it already
            assert {each.key.split(".")[1] for each in made.differences} & {"backbone", "lan"}
            continue
        assert made.kept == {}
        # the operator's template for meshmerize has the node's name
        assert [each.line for each in made.differences if each.rendered != "again"] == []
        same = replace(
            entry,
            # what a device does not know
            name=node.name,
            robot=node.robot,
            serial=node.serial,
            mac=node.mac,
            host_keys=node.host_keys,
            position=node.position,
            groups=node.groups,
        )
        assert same == node


def again(node: Node) -> ImportOptions:
    """The same device under another name, since an entry is never changed."""
    return ImportOptions(name="again", role=node.role.value, state=node.state.value, groups=node.groups)


def imported(copy: Path, fleet: Fleet, device: Any, options: ImportOptions) -> DeviceImport:
    def load(values: Mapping[tuple[str, ...], Any]) -> Fleet:
        return edited(copy, {}, values).fleet()

    return import_device(device, fleet, options, load, placeholder_secret)
