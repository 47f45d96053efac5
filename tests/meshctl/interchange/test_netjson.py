"""NetJSON: the planned graph, and configurations that netjsonconfig, an independent reader, accepts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from netjsonconfig import OpenWrt
from typer.testing import CliRunner, Result

from meshctl.cli.main import build
from meshctl.interchange.netjson import configurations, network_graph
from meshctl.inventory import load_fleet
from meshctl.model import FixedPosition, Fleet
from meshctl.render.compare import placeholder_secret
from meshctl.resources import shipped

EXAMPLES = sorted(path.parent.name for path in shipped("inventory").glob("*/fleet.yaml"))


def run(*words: str) -> Result:
    return CliRunner().invoke(build("inventory"), ["inventory", "export", *words])


def example(name: str) -> Fleet:
    fleet = load_fleet(shipped("inventory") / name)
    return replace(fleet, operators=replace(fleet.operators, ssh_keys=("ssh-ed25519 AAAA x",), password_login=True))


def test_the_graph_has_every_pair_of_a_cell_once_and_the_wires_of_a_robot() -> None:
    fleet = load_fleet(shipped("inventory") / "subt-final")
    graph = network_graph(fleet)
    assert (graph["type"], graph["protocol"]) == ("NetworkGraph", "static")
    names = {node["id"]: node["label"] for node in graph["nodes"]}
    assert list(names.values()) == [node.name for node in fleet.managed()]
    pairs = [frozenset((names[link["source"]], names[link["target"]])) for link in graph["links"]]
    count = len(names)
    assert len(pairs) == len(set(pairs)) == count * (count - 1) // 2
    wired = {pair for pair, link in zip(pairs, graph["links"], strict=True) if link["properties"]["wired"]}
    assert frozenset(("husky1-front", "husky1-rear")) in wired
    assert all(link["cost"] == 1.0 for link in graph["links"])


def test_radios_farther_apart_than_the_longest_link_are_not_linked() -> None:
    fleet = load_fleet(shipped("inventory") / "starter")
    places = {"base": (0.0, 0.0), "rover1-b01": (900.0, 0.0), "rover1-b02": (1900.0, 0.0)}
    nodes = {name: replace(fleet.nodes[name], position=FixedPosition(*place)) for name, place in places.items()}
    graph = network_graph(replace(fleet, nodes=nodes, robots={}))
    names = {node["id"]: node["label"] for node in graph["nodes"]}
    assert {(names[link["source"]], names[link["target"]]) for link in graph["links"]} == {
        ("base", "rover1-b01"),
        ("rover1-b01", "rover1-b02"),
    }


def lacking(value: object, members: Mapping[str, type]) -> dict[str, object]:
    """The members that the draft requires and `value` has not, or with another type."""
    assert isinstance(value, Mapping)
    return {name: value.get(name) for name, kind in members.items() if not isinstance(value.get(name), kind)}


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_object_has_the_members_that_the_draft_requires(name: str) -> None:
    """As the draft's schemas have them: no null, also where its text allows one."""
    fleet = example(name)
    graph = network_graph(fleet)
    assert not lacking(graph, dict.fromkeys(("type", "protocol", "version", "metric", "label"), str))
    ids = [node["id"] for node in graph["nodes"]]
    assert len(ids) == len(set(ids))
    for link in graph["links"]:
        assert not lacking(link, {"source": str, "target": str, "cost": float})
        assert {link["source"], link["target"]} <= set(ids)
    nodes = list({node.hardware.name + node.role.value: node for node in fleet.managed()}.values())
    found = configurations(fleet, nodes, placeholder_secret)
    for device in found["collection"] if found["type"] == "NetworkCollection" else [found]:
        radios = {radio["name"] for radio in device["radios"]}
        for radio in device["radios"]:
            assert not lacking(radio, {"protocol": str, "channel": int, "channel_width": int})
        for route in device["routes"]:
            assert not lacking(route, {"device": str, "destination": str, "next": str})
        for interface in device["interfaces"]:
            assert len(interface["name"]) <= 15
            assert interface["type"] != "bridge" or interface["bridge_members"]
            for address in interface.get("addresses", []):
                assert not lacking(address, {"proto": str, "family": str, "address": str, "mask": int})
            if wireless := interface.get("wireless"):
                assert not lacking(wireless, {"mode": str, "ssid": str})
                assert wireless["radio"] in radios
                assert not lacking(
                    wireless.get("encryption", {"protocol": "", "key": ""}), {"protocol": str, "key": str}
                )


@pytest.mark.parametrize("name", EXAMPLES)
def test_netjsonconfig_accepts_and_renders_every_configuration(name: str) -> None:
    fleet = example(name)
    nodes = list({node.hardware.name + node.role.value: node for node in fleet.managed()}.values())
    found = configurations(fleet, nodes, placeholder_secret)
    several = found["collection"] if found["type"] == "NetworkCollection" else [found]
    assert len(several) == len(nodes)
    for node, configuration in zip(nodes, several, strict=True):
        assert configuration["type"] == "DeviceConfiguration"
        text = json.dumps(configuration)
        for mesh in fleet.meshes.values():
            assert mesh.key is None or placeholder_secret(mesh.key).reveal() not in text
        for interface in configuration["interfaces"]:
            # the key is not exported, and netjsonconfig rejects encryption without one
            interface.get("wireless", {}).pop("encryption", None)
        rendered = OpenWrt(configuration)
        rendered.validate()
        uci = rendered.render()
        assert f"option hostname '{node.hostname}'" in uci
        assert f"option channel '{fleet.meshes[node.meshes[0]].channel}'" in uci
        assert f"option ipaddr '{node.address.ip}'" in uci


def test_the_command_writes_both(tmp_path: Path) -> None:
    inventory = str(shipped("inventory") / "subt-final")
    graph = run("-i", inventory, "--format", "netjson")
    assert json.loads(graph.stdout)["type"] == "NetworkGraph"
    out = tmp_path / "base.json"
    assert run("base", "-i", inventory, "--format", "netjson-config", "--out", str(out)).exit_code == 0
    assert json.loads(out.read_text())["general"]["hostname"] == "base"
    refused = run("base", "-i", inventory, "--format", "ansible")
    assert refused.exit_code == 2
    assert "--format ansible exports the whole fleet" in refused.output
