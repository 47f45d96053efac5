"""Robots' own LANs: the addresses of their radios, the router, and where the values come from."""

from __future__ import annotations

from pathlib import Path

from meshctl.inventory.explain import explain
from meshctl.render.host_lists import host_entries
from tests.meshctl.inventory.inventories import HEAD, fleet_of, load_text

TEAM = """\
defaults: {hardware: rocket}
nodes:
  base: {role: base, address: 10.42.0.1}
  husky-[front,rear]: {role: robot, address: {from: 10.42.0.11}}
robots:
  husky: {nodes: ["husky-[front,rear]"], lan: LAN, computer: {address: 10.43.1.10/24}}
"""


def with_lan(lan: str) -> str:
    return TEAM.replace("LAN", lan)


def test_radios_get_the_first_addresses_of_the_lan_in_the_order_of_nodes(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, with_lan("{network: 10.43.1.0/24}"))
    assert {name: str(node.lan_address) for name, node in fleet.nodes.items()} == {
        "base": "None",
        "husky-front": "10.43.1.1/24",
        "husky-rear": "10.43.1.2/24",
    }
    assert str(fleet.robots["husky"].lan) == "10.43.1.0/24"
    assert fleet.router(fleet.robots["husky"]) is fleet.nodes["husky-front"]


def test_a_lost_router_is_replaced_by_the_next_radio(tmp_path: Path) -> None:
    text = with_lan("{network: 10.43.1.0/24}").replace("robots:", "  husky-front: {state: lost}\nrobots:")
    fleet = fleet_of(tmp_path, text)
    router = fleet.router(fleet.robots["husky"])
    assert router is not None
    assert (router.name, str(router.lan_address)) == ("husky-rear", "10.43.1.2/24")


def test_a_set_address_and_a_computed_one_are_explained(tmp_path: Path) -> None:
    fleet = fleet_of(tmp_path, with_lan("{network: 10.43.1.0/24, addresses: {husky-rear: 10.43.1.254}}"))
    found = {
        name: next(value for value in explain(fleet, fleet.nodes[name]) if value.key == "lan_address")
        for name in ("husky-front", "husky-rear")
    }
    assert {name: value.value for name, value in found.items()} == {
        "husky-front": "10.43.1.1/24",
        "husky-rear": "10.43.1.254/24",
    }
    assert found["husky-front"].origin.layer == "rule"
    place = found["husky-rear"].origin.position
    assert place.line is not None
    assert place.column is not None
    line = (tmp_path / "fleet.yaml").read_text(encoding="utf-8").splitlines()[place.line - 1]
    assert line[place.column - 1 :].startswith("10.43.1.254")


def test_an_unknown_radio_is_an_error_with_its_place_and_a_suggestion(tmp_path: Path) -> None:
    loaded = load_text(tmp_path, HEAD + with_lan("{network: 10.43.1.0/24, addresses: {husky-raer: 10.43.1.254}}"))
    (diagnostic,) = loaded.diagnostics
    assert (diagnostic.code, diagnostic.hint) == ("INV036", "did you mean 'husky-rear'?")
    assert diagnostic.path == "robots.husky.lan.addresses.husky-raer"


def test_a_lan_without_room_for_the_radios_is_an_error(tmp_path: Path) -> None:
    loaded = load_text(tmp_path, HEAD + with_lan("{network: 10.43.1.0/31}"))
    (diagnostic,) = loaded.diagnostics
    assert diagnostic.message == "10.43.1.0/31 has no address for the radio 'husky-front'"


def test_a_robot_names_other_computers_on_its_switch(tmp_path: Path) -> None:
    others = "computers: {jetson: {address: 10.43.1.11/24, ssh: {user: nvidia}}}, computer:"
    fleet = fleet_of(tmp_path, with_lan("{network: 10.43.1.0/24}").replace("computer:", others))
    found = [(path, what, str(one.address.ip)) for path, what, one in fleet.robots["husky"].all_computers()]
    assert found == [
        (("computer",), "the computer of husky", "10.43.1.10"),
        (("computers", "jetson"), "jetson of husky", "10.43.1.11"),
    ]
    aliases = {entry.alias: entry.ssh.user for entry in host_entries(fleet, ())}
    assert aliases == {"robot.husky": "", "robot.husky.jetson": "nvidia"}
