"""Independent meshes change at the same time, each in its own order; what depends on each other does not."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import pairwise
from types import MappingProxyType

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.model import Fleet, Node, Role
from meshctl.plan import Cut, Effect, NodePlan, Plan, StageKind, Verdict, fleet_plan
from meshctl.topology import Graph, Link, graph_of
from tests.meshctl.plan.support import fleet

_LENGTH = 3


def chains(count: int, *, canary: bool = False, max_down: int = 1) -> tuple[Fleet, Graph]:
    """`count` meshes, each a chain of three nodes behind a base of its own: m00-base, m00-n1, m00-n2, m00-n3."""
    team = fleet()
    some, mesh = team.nodes["b01"], team.meshes["main"]
    nodes: dict[str, Node] = {}
    links = []
    for number in range(count):
        names = [f"m{number:02}-base", *(f"m{number:02}-n{index}" for index in range(1, _LENGTH + 1))]
        links += [Link(a, b, 0.9) for a, b in pairwise(names)]
        for name in names:
            role = Role.BASE if name.endswith("base") else Role.BEACON
            radios = tuple(replace(radio, mesh=f"m{number:02}") for radio in some.radios)
            nodes[name] = replace(some, name=name, role=role, site=f"s{number:02}", robot="", radios=radios)
    changed = replace(
        team,
        nodes=MappingProxyType(nodes),
        meshes=MappingProxyType({f"m{number:02}": replace(mesh, name=f"m{number:02}") for number in range(count)}),
        apply=replace(team.apply, canary=canary, max_down=max_down),
    )
    return changed, graph_of(nodes, links)


def planned(team: Fleet, graph: Graph) -> Plan:
    effects = (Effect("wifi", Cut.MESH, "test"),)
    plans = {
        name: NodePlan(name, Verdict.CHANGE, effects=effects, meshes=node.meshes, has_cell=True, is_meshed=True)
        for name, node in team.nodes.items()
    }
    return fleet_plan(team, plans, graph, now_s=0.0)


def names(plan: Plan) -> list[tuple[str, ...]]:
    return [stage.nodes for stage in plan.stages]


def with_node(team: Fleet, name: str, **changes: object) -> Fleet:
    return replace(team, nodes=MappingProxyType({**team.nodes, name: replace(team.nodes[name], **changes)}))  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [1, 2, 10, 50])
def test_as_many_stages_for_fifty_meshes_as_for_one(count: int) -> None:
    plan = planned(*chains(count))
    assert names(plan) == [
        tuple(f"m{number:02}-{place}" for number in range(count)) for place in ("n3", "n2", "n1", "base")
    ]
    assert [stage.kind for stage in plan.stages] == [StageKind.ROLLING] * _LENGTH + [StageKind.LAST]


def test_each_mesh_has_its_cut_vertices_and_its_own_pace() -> None:
    plan = planned(*chains(2, canary=True))
    assert names(plan) == [
        ("m00-n3",),
        ("m01-n3", "m00-n2"),
        ("m01-n2", "m00-n1"),
        ("m01-n1",),
        ("m00-base", "m01-base"),
    ]
    assert plan.stages[1].cuts_off == ("m00-n3",)
    assert plan.stages[1].reason == (
        "independent meshes at the same time: m01-n3 is 3 hops away, quality 73%; alone, because it is a cut vertex: "
        "while it is down m00-n3 cannot be reached"
    )
    notes = [note.partition(" of ")[0] for note in plan.notes if "m01-n2" in note]
    assert notes[0].startswith("stage 3: m01-n2 is a cut vertex: m01-n3")
    assert planned(*chains(4)).stages[0].reason == "4 independent meshes at the same time, each starting at its far end"


def _in_order(plan: Plan) -> bool:
    """Whether the nodes of two meshes change one after the other."""
    return all(len(stage.nodes) == 1 for stage in plan.stages)


def test_meshes_with_a_common_node_depend_on_each_other() -> None:
    team, graph = chains(2)
    first, second = team.nodes["m00-n3"], team.nodes["m01-n3"]
    both = (*first.radios, *second.radios)
    assert _in_order(planned(with_node(team, "m00-n3", radios=both), graph))


def test_meshes_that_hear_each_other_or_are_wired_depend_on_each_other() -> None:
    team, graph = chains(2)
    for wired in (False, True):
        links = [*graph.links, Link("m00-n2", "m01-n2", 0.9, wired)]
        assert _in_order(planned(team, graph_of(team.nodes, links)))


def test_meshes_with_a_jump_host_in_the_other_depend_on_each_other() -> None:
    team, graph = chains(2)
    jump = replace(team.nodes["m01-n1"].ssh, jump="m00-base")
    assert _in_order(planned(with_node(team, "m01-n1", ssh=jump), graph))


def test_one_entry_of_several_meshes_lets_them_be_independent_and_is_last() -> None:
    team, graph = chains(2)
    entry = team.nodes["m00-base"]
    radios = (*entry.radios, *(replace(radio, mesh="m01") for radio in entry.radios))
    nodes = {name: replace(node, site="") for name, node in team.nodes.items() if name != "m01-base"}
    nodes["m00-base"] = replace(nodes["m00-base"], radios=radios)
    links = [
        replace(link, a="m00-base", b="m01-n1") if "m01-base" in (link.a, link.b) else link for link in graph.links
    ]
    team = replace(team, nodes=MappingProxyType(nodes))
    plan = planned(team, graph_of(nodes, links))
    assert names(plan) == [("m00-n3", "m01-n3"), ("m00-n2", "m01-n2"), ("m00-n1", "m01-n1"), ("m00-base",)]


def test_both_radios_of_a_robot_are_never_down_together_in_two_meshes() -> None:
    team, graph = chains(2)
    for name in ("m00-n3", "m01-n3", "m00-base", "m01-base"):
        team = with_node(team, name, robot="base-station" if "base" in name else "husky")
    plan = planned(team, graph)
    assert not any(
        {"m00-n3", "m01-n3"} <= set(nodes) or {"m00-base", "m01-base"} <= set(nodes) for nodes in names(plan)
    )
    assert names(plan)[0] == ("m00-n3",)


@given(st.integers(1, 4), st.integers(1, 3), st.booleans(), st.lists(st.tuples(st.integers(0, 3), st.integers(0, 3))))
def test_each_mesh_has_at_most_max_down_nodes_down_and_loses_what_is_said(
    count: int, max_down: int, canary: bool, joined: list[tuple[int, int]]
) -> None:
    team, graph = chains(count, canary=canary, max_down=max_down)
    wires = [
        Link(f"m{a:02}-n2", f"m{b:02}-n2", 1.0, wired=True) for a, b in joined if a != b and a < count and b < count
    ]
    graph = graph_of(team.nodes, [*graph.links, *wires])
    plan = planned(team, graph)
    assert sorted(name for stage in plan.stages for name in stage.nodes) == sorted(team.nodes)
    for stage in plan.stages:
        down = Counter(name.partition("-")[0] for name in stage.nodes)
        assert all(number <= max_down for number in down.values())
        if stage.kind is not StageKind.LAST and not wires:
            assert graph.cut_off_by_all(plan.entries, stage.nodes) == set(stage.cuts_off)
