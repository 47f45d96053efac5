"""A plan of nodes at several sites, without their workers: each mesh is reached through the base of its site."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

from meshctl.apply.context import RunContext
from meshctl.apply.prepare import base_macs
from meshctl.fleet.journal import LastKnown
from meshctl.model import Fleet, Role
from meshctl.plan import Cut, Effect, NodePlan, StageKind, Verdict, fleet_plan
from meshctl.plan.saved import SavedPlan, dump, load
from tests.meshctl.plan.support import SALT, fleet, graph, running

# north: b01 is behind the base, b02 behind b01; south: b03 is its base, b04 and b05 are behind it in a line
MESHES = graph("base-b01", "b01-b02", "b03-b04", "b04-b05")
NORTH, SOUTH = ("base", "b01", "b02"), ("b03", "b04", "b05")


def two_sites() -> Fleet:
    team = fleet()
    nodes = {
        name: replace(
            node, site="north" if name in NORTH else "south", role=Role.BASE if name in ("base", "b03") else node.role
        )
        for name, node in team.nodes.items()
    }
    return replace(team, nodes=MappingProxyType(nodes))


def changing(*names: str) -> dict[str, NodePlan]:
    effects = (Effect("wifi", Cut.MESH, "test"),)
    return {name: NodePlan(name, Verdict.CHANGE, effects=effects, has_cell=True, is_meshed=True) for name in names}


def test_each_site_changes_from_its_far_end_to_its_own_base() -> None:
    plan = fleet_plan(two_sites(), changing(*NORTH, *SOUTH), MESHES, now_s=0.0)
    assert plan.entries == ("base", "b03")
    order = [name for stage in plan.stages for name in stage.nodes]
    for site in (NORTH, SOUTH):
        assert [name for name in order if name in site] == list(reversed(site))
    assert [stage.nodes for stage in plan.stages if stage.kind is StageKind.LAST] == [("base",), ("b03",)]
    cuts = {stage.nodes: stage.cuts_off for stage in plan.stages if stage.kind is StageKind.ROLLING and stage.cuts_off}
    assert cuts == {("b01",): ("b02",), ("b04",): ("b05",)}


def test_a_plan_of_one_site_is_reached_through_its_base_alone() -> None:
    plan = fleet_plan(two_sites(), changing("b04", "b05"), MESHES, now_s=0.0)
    assert plan.entries == ("b03",)
    saved = dump(SavedPlan(plan, SALT, "fleet.yaml"))
    assert load(saved, "plan.json").plan.entries == ("b03",)
    earlier = saved.replace('"entries": [\n  "b03"\n ],\n', "")
    assert earlier != saved
    assert load(earlier, "plan.json").plan.entries == ("b03",)


def test_a_change_is_proven_by_a_route_to_the_base_of_its_own_site() -> None:
    team = two_sites()
    seen = {"base": running(team, "base", macs={"mesh0": "02:00:00:00:00:AA"})}
    known = {"b03": LastKnown("b03", 0.0, {"macs": "02:00:00:00:00:bb"})}
    found = base_macs(team, seen, known)
    assert set(found) == {"base", "b03"}
    context = object.__new__(RunContext)
    for name, value in (("fleet", team), ("base_macs", found), ("macs", {"b03": frozenset({"02:00:00:00:00:cc"})})):
        object.__setattr__(context, name, value)
    assert context.current_base_macs(team.nodes["b05"]) == {"02:00:00:00:00:bb", "02:00:00:00:00:cc"}
    assert context.current_base_macs(team.nodes["b02"]) == {mac.lower() for mac in found["base"]}
