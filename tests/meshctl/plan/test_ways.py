"""`--together` changes all nodes of running meshes in one stage; the plan compares both ways and recommends one."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import pytest

from meshctl.errors import InputError
from meshctl.plan import FirmwareStep, Plan, StageKind, Verdict, fleet_plan
from meshctl.plan.saved import SavedPlan, as_agreed, dump, load
from meshctl.plan.ways import Pace
from meshctl.report.plan_text import plan_lines, question
from meshctl.topology import Graph
from tests.meshctl.plan.support import SALT, factory, fleet, graph, plans, running

TEAM = ("base", "b01", "b02", "b03", "b04", "b05")
CHAIN = graph(*(f"{near}-{far}" for near, far in pairwise(TEAM)))
STAR = graph(*(f"base-{name}" for name in TEAM[1:]))


def changed_power(
    mesh: Graph, *, together: bool, factory_devices: tuple[str, ...] = (), pace: Pace | None = None
) -> Plan:
    """Every radio restarts, and no node leaves its cell."""
    new = fleet()
    seen = {}
    for name in TEAM:
        if name in factory_devices:
            seen[name] = factory(new, name)
            continue
        now = running(new, name)
        assert now.uci is not None
        old = now.uci["wireless"].replace("option distance '", "option distance '1")
        seen[name] = replace(now, uci={**now.uci, "wireless": old})
    return fleet_plan(new, plans(new, seen), mesh, now_s=0.0, together=together, pace=pace)


def text(plan: Plan) -> str:
    return "\n".join(line.text for line in plan_lines(plan, with_diffs=False))


def test_together_is_one_stage_from_the_far_end_with_the_entry_last() -> None:
    (stage,) = changed_power(CHAIN, together=True).stages
    assert (stage.kind, stage.mesh) == (StageKind.TOGETHER, "main")
    assert stage.nodes == ("b05", "b04", "b03", "b02", "b01", "base")
    assert stage.reason == "6 nodes simultaneously, rolled back unless 80% pass their checks"


def test_nodes_outside_the_running_mesh_are_changed_before() -> None:
    first, stage = changed_power(CHAIN, together=True, factory_devices=("b05",)).stages
    assert (first.kind, first.nodes) == (StageKind.FREE, ("b05",))
    assert (stage.kind, len(stage.nodes)) == (StageKind.TOGETHER, 5)


def test_a_change_of_the_cell_is_part_of_it() -> None:
    new = fleet(channel=11)
    seen = {name: running(fleet(), name) for name in TEAM}
    plan = fleet_plan(new, plans(new, seen), STAR, now_s=0.0, together=True)
    assert [(stage.kind, set(stage.nodes)) for stage in plan.stages] == [(StageKind.TOGETHER, set(TEAM))]
    assert plan.ways == (), "both ways do the same"


def test_both_plans_show_both_ways_and_the_one_that_fits_the_mesh() -> None:
    in_order, together = (changed_power(CHAIN, together=chosen, pace=Pace(10.0, 7)) for chosen in (False, True))
    assert in_order.ways == together.ways
    rolling, at_once = in_order.ways
    assert (rolling.name, rolling.stages, rolling.outages, rolling.estimated_s) == ("in order", 6, 6, 60.0)
    assert (at_once.name, at_once.stages, at_once.outages, at_once.estimated_s) == ("together", 1, 1, 26.0)
    assert (rolling.is_recommended, at_once.is_recommended) == (False, True)
    assert at_once.reason == "each node is interrupted at most once, not 6 times"
    assert "b05 is interrupted or cut off 6 times, no node more often" in rolling.risk
    assert "unless 80% pass their checks, all of them return to their previous state" in at_once.risk
    for plan in (in_order, together):
        assert "two ways (from the latest 7 changes, 10 s each)" in text(plan)
        assert "  recommended: together, because each node is interrupted at most once, not 6 times" in text(plan)
    assert "in order  this plan: 6 stages, about 60 s" in text(in_order)
    assert "together  this plan: 1 stage, about 26 s" in text(together)
    assert question(together) == "Change 6 nodes (6 simultaneously)?"


def test_where_no_node_cuts_off_others_the_order_is_recommended() -> None:
    rolling, at_once = changed_power(STAR, together=True).ways
    assert (rolling.outages, rolling.is_recommended, at_once.is_recommended) == (2, True, False)


def test_an_order_that_takes_many_minutes_longer_is_not_recommended() -> None:
    rolling, at_once = changed_power(STAR, together=False, pace=Pace(90.0, 3)).ways
    assert not rolling.is_recommended
    assert at_once.reason == "it takes 5 minutes less"


def test_firmware_is_refused_and_a_plan_without_it_is_not() -> None:
    plan = changed_power(STAR, together=True)
    flashed = replace(plan.nodes["b02"], firmware=FirmwareStep("box.bin", "0", "r1", "r2"))
    made = fleet_plan(fleet(), {**plan.nodes, "b02": flashed}, STAR, now_s=0.0, together=True, accept_cuts=["all"])
    assert made.refusal == "the firmware of b02 changes, and a flash cannot be rolled back with the others"
    assert made.refusal_hint.startswith("change firmware first, without --together")
    assert (plan.refusal, made.ways) == ("", ())


def test_a_saved_plan_keeps_both_ways_and_binds_all_nodes() -> None:
    plan = changed_power(CHAIN, together=True)
    loaded = load(dump(SavedPlan(plan, SALT, "inventory")), "plan.json").plan
    assert (loaded.stages, loaded.ways, loaded.pace) == (plan.stages, plan.ways, plan.pace)
    gone = {**plan.nodes, "b03": replace(plan.nodes["b03"], verdict=Verdict.AWAY)}
    agreed = as_agreed(loaded, replace(plan, nodes=gone))
    assert agreed.refusal == "mesh main changes its nodes simultaneously, but b03 cannot take part as planned"


def test_a_plan_of_an_earlier_version_has_no_ways() -> None:
    written = dump(SavedPlan(changed_power(STAR, together=False), SALT, "inventory"))
    earlier = written.replace('"ways"', '"other"').replace('"pace"', '"another"')
    assert load(earlier, "plan.json").plan.ways == ()
    with pytest.raises(InputError, match="damaged plan"):
        load(written.replace('"outages"', '"outage"'), "plan.json")


def test_the_pace_is_the_median_of_earlier_changes() -> None:
    assert Pace.of([8.0, 9.0, 100.0]) == Pace(9.0, 3)
    assert Pace.of([]).text == "assuming 12 s per change"
