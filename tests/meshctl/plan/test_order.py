"""The order of a fleet: farthest first, cut vertices alone, nothing cut off by accident, the entry last."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from hypothesis import given
from hypothesis import strategies as st

from meshctl.model import ApplyPolicy
from meshctl.plan import Cut, Effect, NodePlan, StageKind, Verdict
from meshctl.plan.order import MeshContext, stages_of
from meshctl.topology import Graph, Link, graph_of
from tests.meshctl.plan.support import graph

NAMES = ["base", *(f"b{index:02}" for index in range(8))]


def changing(name: str, *, cut: Cut = Cut.MESH, is_meshed: bool = True) -> NodePlan:
    return NodePlan(
        name, Verdict.CHANGE, effects=(Effect("wifi", cut, "test"),), has_cell=is_meshed, is_meshed=is_meshed
    )


def around(mesh: Graph, *, max_down: int = 1, canary: bool = False, **robots: str) -> MeshContext:
    return MeshContext(mesh, ("base",), ApplyPolicy(max_down=max_down, canary=canary), MappingProxyType(robots))


@st.composite
def meshes(draw: st.DrawFn) -> Graph:
    pairs = draw(st.lists(st.tuples(st.sampled_from(NAMES), st.sampled_from(NAMES)), max_size=16))
    return graph_of(NAMES, [Link(a, b, 0.9) for a, b in pairs])


@given(meshes(), st.integers(1, 4), st.booleans(), st.sets(st.sampled_from(NAMES)))
def test_every_node_is_in_one_stage_of_at_most_max_down_nodes(
    mesh: Graph, max_down: int, canary: bool, names: set[str]
) -> None:
    stages = stages_of([changing(name) for name in names], around(mesh, max_down=max_down, canary=canary))
    assert sorted(name for stage in stages for name in stage.nodes) == sorted(names)
    assert all(len(stage.nodes) <= max_down for stage in stages)


@given(meshes(), st.integers(1, 4))
def test_nodes_down_together_cut_off_only_what_one_node_alone_would(mesh: Graph, max_down: int) -> None:
    for stage in stages_of([changing(name) for name in NAMES], around(mesh, max_down=max_down)):
        lost = mesh.cut_off_by_all(["base"], stage.nodes)
        if stage.kind is not StageKind.LAST:
            assert lost == set(stage.cuts_off)
        assert not stage.cuts_off or len(stage.nodes) == 1


@given(meshes())
def test_stages_run_from_the_farthest_node_to_the_base(mesh: Graph) -> None:
    stages = stages_of([changing(name) for name in NAMES], around(mesh))
    paths = mesh.paths("base")
    hops = [paths[stage.nodes[0]].hops if stage.nodes[0] in paths else len(NAMES) for stage in stages]
    assert hops == sorted(hops, reverse=True)
    assert stages[-1].kind is StageKind.LAST
    assert stages[-1].nodes == ("base",)


def test_a_line_topology_is_changed_from_its_far_end() -> None:
    stages = stages_of([changing(name) for name in NAMES[:4]], around(graph("base-b00", "b00-b01", "b01-b02")))
    assert [stage.nodes for stage in stages] == [("b02",), ("b01",), ("b00",), ("base",)]
    assert stages[1].reason == "alone, because it is a cut vertex: while it is down b02 cannot be reached"
    assert stages[0].reason == "b02 is 3 hops away, quality 73%"


def test_a_cut_vertex_with_weak_links_gets_its_own_stage() -> None:
    mesh = graph("base-b00", "b00-b01", "b01-b02")
    stages = stages_of([changing(name, cut=Cut.WEAK_LINKS) for name in ("b01", "b02")], around(mesh))
    assert [stage.nodes for stage in stages] == [("b02",), ("b01",)]
    assert stages[1].reason == "alone, because it is a cut vertex: b02 cannot be reached if a weak link breaks"
    assert stages[1].cuts_off == ("b02",)


def test_the_canary_is_the_farthest_node_that_is_not_a_cut_vertex() -> None:
    mesh = graph("base-b00", "base-b01", "b01-b02")
    stages = stages_of([changing(name) for name in ("b00", "b01", "base")], around(mesh, canary=True))
    assert [(stage.kind, stage.nodes) for stage in stages] == [
        (StageKind.CANARY, ("b00",)),
        (StageKind.ROLLING, ("b01",)),
        (StageKind.LAST, ("base",)),
    ]


def test_both_radios_of_a_robot_are_never_down_together() -> None:
    mesh = graph("base-b00", "base-b01", "base-b02")
    stages = stages_of(
        [changing(name) for name in ("b00", "b01", "b02")], around(mesh, max_down=3, b00="husky", b01="husky")
    )
    assert [stage.nodes for stage in stages] == [("b00", "b02"), ("b01",)]


def test_unmeshed_nodes_and_harmless_changes_precede_disruptive_ones() -> None:
    mesh = graph("base-b00", "base-b01", "base-b02")
    stages = stages_of(
        [
            changing("b00"),
            changing("b01", cut=Cut.NOTHING),
            changing("b02", cut=Cut.LOGIN),
            changing("new1", is_meshed=False),
            changing("new2", is_meshed=False),
        ],
        around(mesh),
    )
    assert [(stage.kind, stage.nodes) for stage in stages] == [
        (StageKind.FREE, ("new1", "new2")),
        (StageKind.FREE, ("b01", "b02")),
        (StageKind.ROLLING, ("b00",)),
    ]


def test_a_switch_is_one_stage_with_the_entry_last() -> None:
    plans = [replace(changing(name), splits=("radio0: channel 6 -> 11",)) for name in ("base", "b00", "b01")]
    (stage,) = stages_of(plans, around(graph("base-b00", "b00-b01")), {"main": ["base", "b00", "b01"]})
    assert (stage.kind, stage.mesh, stage.nodes) == (StageKind.SWITCH, "main", ("b01", "b00", "base"))


def test_an_empty_plan_has_no_stages() -> None:
    assert stages_of([], around(graph("base-b00"))) == ()
