"""Static routes between robots' LANs, and their computers' gateways."""

from __future__ import annotations

from dataclasses import replace
from ipaddress import IPv4Address, IPv4Interface
from types import MappingProxyType

import pytest

from meshctl.diagnostics import InvalidInput
from meshctl.model import Backend, Computer, Fleet, NodeState
from meshctl.resolve import computer_gateway, resolve, routes
from tests.meshctl.render import fleets


def routes_of(fleet: Fleet, name: str) -> dict[str, str]:
    return {str(route.target): str(route.gateway) for route in routes(fleet, fleet.nodes[name])}


def test_every_node_has_a_route_to_each_lan_but_its_own() -> None:
    fleet = fleets.routed_lans()
    assert routes_of(fleet, "husky1-front") == {"10.43.2.0/24": "10.42.0.12"}
    assert routes_of(fleet, "spot-radio") == {"10.43.1.0/24": "10.42.0.11"}
    # a node that bridges relays packets to both
    assert routes_of(fleet, "base") == {"10.43.1.0/24": "10.42.0.11", "10.43.2.0/24": "10.42.0.12"}


def test_there_is_no_route_through_a_lost_radio_or_one_in_another_network() -> None:
    fleet = fleets.routed_lans()
    lost = replace(fleet.nodes["spot-radio"], state=NodeState.LOST)
    elsewhere = replace(fleet.nodes["husky1-front"], address=IPv4Interface("10.44.0.11/24"))
    nodes = MappingProxyType({**fleet.nodes, "spot-radio": lost, "husky1-front": elsewhere})
    assert routes_of(replace(fleet, nodes=nodes), "base") == {}


def test_a_router_has_its_management_address_on_the_mesh_and_no_mesh_in_its_bridge() -> None:
    fleet = fleets.routed_lans()
    intent = resolve(fleet, fleet.nodes["spot-radio"], fleets.secrets)
    assert intent.backbone is not None
    assert (intent.backbone.device, str(intent.backbone.address)) == ("bat0", "10.42.0.12/24")
    assert intent.backbone.mac == "02:ba:0a:2a:00:0c"
    assert (str(intent.lan.address), intent.lan.ports) == ("10.43.2.1/24", ("eth0.1",))
    bridged = resolve(fleet, fleet.nodes["base"], fleets.secrets)
    assert (bridged.backbone, bridged.lan.ports) == (None, ("eth0.1", "bat0"))


def test_a_gateway_belongs_to_the_interface_of_its_network() -> None:
    fleet = fleets.routed_lans()
    node = replace(fleet.nodes["spot-radio"], gateway=IPv4Address("10.43.2.254"))
    intent = resolve(fleet, node, fleets.secrets)
    assert intent.backbone is not None
    assert (intent.backbone.gateway, intent.lan.gateway) == (None, IPv4Address("10.43.2.254"))


def test_a_lan_behind_another_back_end_is_refused() -> None:
    fleet = fleets.routed_lans()
    mesh = replace(fleet.meshes["main"], backend=Backend.MESHMERIZE)
    with pytest.raises(InvalidInput, match="needs batman-adv"):
        resolve(replace(fleet, meshes=MappingProxyType({"main": mesh})), fleet.nodes["spot-radio"], fleets.secrets)


def test_the_gateway_of_a_computer_defaults_to_its_robots_router_or_radio() -> None:
    fleet = fleets.routed_lans()
    found = {name: str(computer_gateway(fleet, robot)) for name, robot in fleet.robots.items()}
    assert found == {"base-station": "10.42.0.1", "husky1": "10.43.1.1", "spot": "10.43.2.1"}
    computer = Computer(IPv4Interface("10.43.2.10/24"), gateway=IPv4Address("10.43.2.9"))
    assert computer_gateway(fleet, replace(fleet.robots["spot"], computer=computer)) == IPv4Address("10.43.2.9")
    # one network: no computer needs a gateway
    assert computer_gateway(fleets.fleet(), fleets.fleet().robots["husky1"]) is None
