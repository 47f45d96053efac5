"""The mesh model: properties of edges and routes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshlab import mesh_model
from meshlab.mesh_model import Address, EffectiveState, WirelessInterface
from meshlab.spec import LinkSpec

CELL = WirelessInterface(
    "mesh0", "adhoc", 2437, "team", "02:ca:fe:00:00:01", "none", "", "02:00:00:00:00:01", "bat0", "BATMAN_IV"
)


def node(number: int, **changes: object) -> EffectiveState:
    cell = replace(CELL, mac=f"02:00:00:00:00:{number:02x}", **changes)  # type: ignore[arg-type]
    return EffectiveState((cell,), (Address("lan", "br-lan", f"10.42.0.{number}", 24, True, True),))


def chain(count: int) -> tuple[dict[str, EffectiveState], list[LinkSpec]]:
    names = [f"n{number}" for number in range(count)]
    return (
        {name: node(number) for number, name in enumerate(names)},
        [LinkSpec(a, b, tq=250) for a, b in pairwise(names)],
    )


@pytest.mark.parametrize(
    "change",
    [
        {"frequency_mhz": 2462},
        {"ssid": "other"},
        {"bssid": "02:ca:fe:00:00:02"},
        {"mode": "mesh"},
        {"algorithm": "psk2", "key": "secret"},
    ],
)
def test_nodes_with_different_cell_settings_are_not_linked(change: dict[str, object]) -> None:
    nodes = {"a": node(1), "b": node(2, **change)}
    assert mesh_model.edges(nodes, [LinkSpec("a", "b")]) == {"a": [], "b": []}


def test_nodes_in_one_cell_are_linked_in_both_directions_only_over_up_links() -> None:
    nodes = {"a": node(1), "b": node(2), "c": node(3)}
    graph = mesh_model.edges(nodes, [LinkSpec("a", "b"), LinkSpec("b", "c", up=False)])
    assert {name: [edge.node for edge in found] for name, found in graph.items()} == {"a": ["b"], "b": ["a"], "c": []}


def test_nodes_with_different_routing_algorithms_are_linked_but_not_routed() -> None:
    nodes = {"a": node(1), "b": node(2, routing="BATMAN_V")}
    graph = mesh_model.edges(nodes, [LinkSpec("a", "b")])
    assert len(graph["a"]) == 1
    assert mesh_model.best_routes(graph, "a") == {}


def test_the_best_route_prefers_a_better_detour() -> None:
    nodes = {"a": node(1), "b": node(2), "c": node(3)}
    links = [LinkSpec("a", "c", tq=80), LinkSpec("a", "b", tq=250), LinkSpec("b", "c", tq=250)]
    path = mesh_model.best_routes(mesh_model.edges(nodes, links), "a")["c"]
    assert path.first.node == "b"
    assert [link.ends for link in path.links] == [frozenset("ab"), frozenset("bc")]
    assert path.tq == 250 * 250 // 255 * (255 - mesh_model.HOP_PENALTY) // 255


def test_equal_routes_are_resolved_deterministically() -> None:
    nodes = {name: node(number) for number, name in enumerate("abcd")}
    links = [LinkSpec(one, other, tq=200) for one, other in ("ab", "ac", "bd", "cd")]
    taken = {mesh_model.best_routes(mesh_model.edges(nodes, links), "a")["d"].first.node for _ in range(3)}
    assert taken == {"b"}


@given(st.integers(2, 12), st.data())
def test_cutting_a_chain_separates_exactly_the_nodes_behind_the_cut(count: int, data: st.DataObject) -> None:
    nodes, links = chain(count)
    cut = data.draw(st.integers(0, count - 2))
    links[cut] = replace(links[cut], up=False)
    reached = mesh_model.best_routes(mesh_model.edges(nodes, links), "n0")
    assert set(reached) == {f"n{number}" for number in range(1, cut + 1)}


def test_heard_text_has_one_line_per_station_neighbor_and_originator() -> None:
    nodes, links = chain(3)
    graph = mesh_model.edges(nodes, links)
    lines = [
        line.split("\t")
        for line in mesh_model.heard_text("n0", nodes, graph, mesh_model.best_routes(graph, "n0")).splitlines()
    ]
    assert [line[0] for line in lines] == ["S", "N", "O", "O"]
    assert {line[2] for line in lines if line[0] == "O"} == {"02:00:00:00:00:01", "02:00:00:00:00:02"}
    assert {line[3] for line in lines if line[0] == "O"} == {"02:00:00:00:00:01"}


def test_effective_state_written_by_the_stand_in_is_parsed() -> None:
    text = (
        "addr\tlan\tbr-lan\t10.42.0.11\t24\t1\t0\n"
        "cell\tradio0\tmesh0\tadhoc\t2437\ta team\t02:ca:fe:00:00:01\tnone\t\t02:4d:00:00:00:01\tbat0\tBATMAN_IV\n"
    )
    read = mesh_model.parse_effective(text)
    assert read.holds("10.42.0.11", over="mesh")
    assert not read.holds("10.42.0.11", over="wire")
    assert read.interfaces[0].ssid == "a team"


BASE = """\
forward\tbr-lan\tbat0
addr\tlan\tbr-lan\t10.43.0.1\t24\t0\t1\t1
addr\tbackbone\tbat0\t10.42.0.1\t24\t1\t0\t1
"""


def test_a_router_leads_into_the_mesh_only_if_its_firewall_forwards() -> None:
    assert mesh_model.parse_effective(BASE).routes_lan_and_mesh
    assert not mesh_model.parse_effective(BASE.replace("forward\tbr-lan\tbat0\n", "")).routes_lan_and_mesh
    assert not mesh_model.parse_effective(BASE).bridges_lan_and_mesh


def test_a_node_answers_through_a_router_only_with_a_route_back() -> None:
    base = mesh_model.parse_effective(BASE)
    route = "route\tbr-lan\t10.43.0.0\t24\t10.42.0.1\n"
    assert mesh_model.parse_effective(route).answers_through(base)
    assert not mesh_model.parse_effective(route.replace("10.42.0.1", "10.42.0.9")).answers_through(base)
    assert not mesh_model.parse_effective("").answers_through(base)
