"""The fleet plan: a cell change is one stage, no node is left behind unacknowledged, a saved plan binds."""

from __future__ import annotations

import json
from dataclasses import replace
from types import MappingProxyType

import pytest

from meshctl.errors import InputError
from meshctl.model import Fleet, Node, NodeState
from meshctl.plan import NodePlan, Plan, StageKind, Verdict, fleet_plan
from meshctl.plan.saved import SavedPlan, dump, load, stale_reason
from tests.meshctl.plan.support import PASS_PHRASE, SALT, factory, fleet, graph, planned, plans, running, two_meshes

TEAM = ("base", "b01", "b02", "b03", "b04", "b05")
STAR = graph(*(f"base-{name}" for name in TEAM[1:]))


def with_state(team: Fleet, name: str, state: NodeState) -> Fleet:
    nodes: dict[str, Node] = {**team.nodes, name: replace(team.nodes[name], state=state)}
    return replace(team, nodes=MappingProxyType(nodes))


def changed_channel(*, away: tuple[str, ...] = (), already: tuple[str, ...] = ()) -> Plan:
    new = fleet(channel=11)
    seen = {name: None if name in away else running(new if name in already else fleet(), name) for name in TEAM}
    return fleet_plan(new, plans(new, seen), STAR, now_s=0.0)


def test_another_channel_is_one_switch_of_the_whole_mesh() -> None:
    plan = changed_channel()
    assert [(stage.kind, set(stage.nodes)) for stage in plan.stages] == [(StageKind.SWITCH, set(TEAM))]
    assert plan.refusal == ""


def switches_of(new: Fleet) -> list[tuple[str, set[str]]]:
    """The switches that lead from both meshes as they are to `new`."""
    seen = {name: running(two_meshes(), name) for name in new.nodes}
    stages = fleet_plan(new, plans(new, seen), graph("base-b01", "b01-b02", "b02-b03", "b03-b04"), now_s=0.0).stages
    assert all(stage.kind is StageKind.SWITCH for stage in stages)
    return [(stage.mesh, set(stage.nodes)) for stage in stages]


def test_meshes_that_share_a_changing_node_are_one_switch() -> None:
    everybody = {"base", "b01", "b02", "b03", "b04"}
    assert switches_of(two_meshes(channel=11, far_channel=40)) == [("main, far", everybody)]


def test_a_node_in_two_meshes_switches_with_the_changed_one() -> None:
    assert switches_of(two_meshes(channel=11)) == [("main", {"base", "b01", "b02"})]
    assert switches_of(two_meshes(far_channel=40)) == [("far", {"b02", "b03", "b04"})]


def test_a_relay_that_leaves_a_mesh_cuts_off_what_is_behind_it_for_good() -> None:
    team = two_meshes()
    relay = team.nodes["b02"]
    alone = replace(
        relay, radios=tuple(replace(one, mesh=one.mesh if one.mesh == "main" else None) for one in relay.radios)
    )
    new = replace(team, nodes=MappingProxyType({**team.nodes, "b02": alone}))
    seen = {name: running(team, name) for name in new.nodes}
    notes = fleet_plan(new, plans(new, seen), graph("base-b01", "b01-b02", "b02-b03", "b03-b04"), now_s=0.0).notes
    assert notes == (
        "b02: changes its cell alone (radio1: leaves the mesh): the others already run the inventory's",
        "stage 1: b02 is a cut vertex: b03, b04 will be unreachable from then on, unless another node relays for them",
    )


def test_a_switch_leaves_nodes_behind_only_if_acknowledged() -> None:
    plan = changed_channel(away=("b03",))
    assert "would leave behind b03" in plan.refusal
    assert plan.refusal_hint == "switch them on and select them too, or acknowledge with --leave-behind b03"
    new = fleet(channel=11)
    seen = {name: None if name == "b03" else running(fleet(), name) for name in TEAM}
    # the option is given once: following the hint had only exchanged the names
    other = fleet_plan(new, plans(new, seen), STAR, now_s=0.0, leave_behind=["b02"])
    assert other.refusal_hint.endswith("acknowledge with --leave-behind b02,b03")
    assert fleet_plan(new, plans(new, seen), STAR, now_s=0.0, leave_behind=["b03"]).refusal == ""
    assert fleet_plan(new, plans(new, seen), STAR, now_s=0.0, leave_behind=["all"]).refusal == ""
    assert fleet_plan(new, plans(new, seen), STAR, now_s=0.0, never_meshed=["b03"]).refusal == ""
    spare = with_state(new, "b03", NodeState.SPARE)
    assert fleet_plan(spare, plans(new, seen), STAR, now_s=0.0).refusal == ""


def test_a_node_that_may_still_return_to_its_former_cell_is_waited_for() -> None:
    new = fleet(channel=11)
    seen = {name: None if name in ("b03", "b04") else running(fleet(), name) for name in TEAM}
    plan = fleet_plan(new, plans(new, seen), STAR, now_s=100.0, returning={"b03": 161.0})
    assert plan.refusal.startswith("mesh main changes its cell, and b03 may still roll back an earlier change")
    assert plan.refusal_hint == "plan again when they answer, or at the latest after 00:02:41 UTC"
    later = fleet_plan(new, plans(new, seen), STAR, now_s=162.0, returning={"b03": 161.0})
    assert "would leave behind b03, b04" in later.refusal


def test_a_switch_of_a_part_of_the_mesh_is_refused() -> None:
    new = fleet(channel=11)
    some = plans(new, {name: running(fleet(), name) for name in TEAM[:3]})
    assert "would leave behind b03, b04, b05" in fleet_plan(new, some, STAR, now_s=0.0).refusal


def test_a_node_left_in_the_old_cell_rejoins_alone() -> None:
    new = fleet(channel=11)
    stray = plans(new, {"b01": running(fleet(), "b01")})
    others = plans(new, {name: running(new, name) for name in TEAM if name != "b01"})
    plan = fleet_plan(new, stray, STAR, now_s=0.0, unchanged=others)
    assert (plan.refusal, [stage.nodes for stage in plan.stages]) == ("", [("b01",)])
    assert plan.stages[0].kind is not StageKind.SWITCH


def test_a_node_that_departs_from_the_running_cell_does_not_rejoin_it() -> None:
    earlier, now = fleet(channel=6), fleet(channel=11)
    departing = plans(earlier, {"b01": running(now, "b01")})
    departing = {name: replace(plan, departs=plan.meshes) for name, plan in departing.items()}
    others = plans(now, {name: running(now, name) for name in TEAM if name != "b01"})
    plan = fleet_plan(now, departing, STAR, now_s=0.0, unchanged=others)
    assert "would leave behind base, b02, b03, b04, b05" in plan.refusal
    assert plan.notes == ()
    assert fleet_plan(now, departing, STAR, now_s=0.0, unchanged=others, leave_behind=["all"]).refusal == ""


def test_unselected_members_in_the_old_cell_block_a_partial_switch() -> None:
    new = fleet(channel=11)
    some = plans(new, {name: running(fleet(), name) for name in TEAM[:3]})
    others = plans(new, {name: running(fleet(), name) for name in TEAM[3:]})
    assert "would leave behind b03, b04, b05" in fleet_plan(new, some, STAR, now_s=0.0, unchanged=others).refusal


def test_refused_members_in_the_old_cell_block_a_switch() -> None:
    new = fleet(channel=11)
    seen = {name: running(fleet(), name, uci_changes=("system.x",) if name > "b01" else ()) for name in TEAM}
    plan = fleet_plan(new, plans(new, seen), STAR, now_s=0.0)
    assert "changes its cell, but not every member can take part" in plan.refusal
    assert plan.refusal_hint == "fix the refused nodes, then plan again"


def test_a_base_without_neighbors_cannot_leave_its_mesh_unacknowledged() -> None:
    new = fleet(channel=11)
    seen = {name: running(fleet(), name, neighbors=()) if name == "base" else None for name in TEAM}
    assert "would leave behind b01" in fleet_plan(new, plans(new, seen), STAR, now_s=0.0).refusal


def test_a_stray_node_rejoins_its_mesh_without_a_switch() -> None:
    plan = changed_channel(already=TEAM[:5])
    assert [(stage.kind, stage.nodes) for stage in plan.stages] == [(StageKind.ROLLING, ("b05",))]
    assert plan.notes[0].startswith("b05: changes its cell alone (radio0: ")


def test_a_switch_with_a_refused_member_is_refused() -> None:
    new = fleet(channel=11)
    seen = {name: running(fleet(), name) for name in TEAM}
    seen["b02"] = replace(seen["b02"], uci_changes=("network.lan=x",))
    assert "b02: it has uncommitted UCI changes" in fleet_plan(new, plans(new, seen), STAR, now_s=0.0).refusal


def test_a_switch_combined_with_a_firmware_change_is_refused() -> None:
    new = fleet(channel=11, firmware="firmware: {image: box.bin, revision: r24106}")
    plan = fleet_plan(new, plans(new, {name: running(fleet(), name) for name in TEAM}), STAR, now_s=0.0)
    assert "its firmware changes too" in plan.refusal


def test_flashing_a_cut_vertex_has_to_be_acknowledged() -> None:
    team = fleet(firmware="firmware: {image: box.bin, revision: r24106}")
    line = graph("base-b01", "b01-b02")
    todo = plans(team, {"b01": running(team, "b01")})
    plan = fleet_plan(team, todo, line, now_s=0.0)
    assert plan.refusal == "flashing b01 cuts off b02, permanently if it does not come back"
    assert fleet_plan(team, todo, line, now_s=0.0, accept_cuts=["b01"]).refusal == ""


def test_factory_devices_are_provisioned_all_at_once() -> None:
    team = fleet(canary=True)
    plan = fleet_plan(team, plans(team, {name: factory(team, name) for name in TEAM}), graph(), now_s=0.0)
    assert [(stage.kind, len(stage.nodes)) for stage in plan.stages] == [(StageKind.FREE, 6)]


def test_formerly_meshed_nodes_without_neighbors_get_a_canary() -> None:
    new = fleet(canary=True, max_down=2)
    seen = {}
    for name in TEAM[:3]:
        observation = running(fleet(), name, neighbors=())
        assert observation.uci is not None
        seen[name] = replace(observation, uci={**observation.uci, "dhcp": ""})
    plan = fleet_plan(new, plans(new, seen), graph(), now_s=0.0)
    assert [(stage.kind, len(stage.nodes)) for stage in plan.stages] == [(StageKind.CANARY, 1), (StageKind.FREE, 2)]


def test_an_up_to_date_fleet_has_an_empty_plan() -> None:
    plan = fleet_plan(fleet(), plans(fleet(), {name: running(fleet(), name) for name in TEAM}), STAR, now_s=0.0)
    assert plan.is_empty
    assert len(plan.of(Verdict.SAME)) == len(TEAM)


def test_a_saved_plan_round_trips_and_contains_no_secrets() -> None:
    team = fleet(channel=11, firmware="firmware: {image: box.bin, revision: r24106}")
    seen = {"base": running(fleet(), "base"), "b01": factory(fleet(), "b01"), "b02": None}
    saved = SavedPlan(fleet_plan(team, plans(team, seen), STAR, now_s=12.5), SALT, "inventory/")
    text = dump(saved)
    assert load(text, "plan.json") == saved
    assert PASS_PHRASE not in text


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda document: document.update(format="other"), "expected a plan written by"),
        (lambda document: document.update(version=9), "expected a plan of version 3, found 9"),
        (lambda document: document.pop("stages"), "'stages' is missing"),
        (lambda document: document["nodes"][0].update(verdict="maybe"), "'maybe' is not a valid Verdict"),
        (lambda document: document["stages"][0].update(nodes=["b99"]), "stages name b99"),
        (lambda document: document["stages"][0].update(nodes="b99"), "expected a list"),
        (lambda document: document["nodes"][0].update(firmware={"x": "y"}), "damaged plan"),
        (lambda document: document.update(nodes=7), "damaged plan"),
    ],
)
def test_a_damaged_plan_is_refused_with_its_file(damage: object, message: str) -> None:
    assert callable(damage)
    document = json.loads(dump(SavedPlan(changed_channel(), SALT, "i")))
    damage(document)
    with pytest.raises(InputError, match=r"plan\.json") as caught:
        load(json.dumps(document), "plan.json")
    assert message in str(caught.value)


def test_invalid_json_is_rejected() -> None:
    with pytest.raises(InputError, match=r"x\.json: expected a plan in JSON"):
        load("{", "x.json")


def test_a_stale_plan_is_distinguished_from_one_that_still_applies() -> None:
    agreed = planned(fleet(channel=11), "b01", running(fleet(), "b01"))
    assert stale_reason(agreed, agreed) == ""
    edited = running(fleet(), "b01")
    assert edited.uci is not None
    edited = replace(edited, uci={**edited.uci, "dhcp": edited.uci["dhcp"] + "config dhcp 'wan'\n"})
    assert "has changed since" in stale_reason(agreed, planned(fleet(channel=11), "b01", edited))
    assert "inventory has changed" in stale_reason(agreed, planned(fleet(channel=1), "b01", running(fleet(), "b01")))
    rebooted = replace(running(fleet(), "b01"), boot_id="another", uptime_s=3.0)
    assert stale_reason(agreed, planned(fleet(channel=11), "b01", rebooted)) == ""


def test_a_refusal_counts_the_nodes_that_it_would_leave_behind() -> None:
    """It listed 75 names, and its hint listed them again."""
    new = fleet(channel=11)
    more = {f"h{number:02}": replace(new.nodes["b05"], name=f"h{number:02}") for number in range(75)}
    large = replace(new, nodes=MappingProxyType({**new.nodes, **more}))
    made = plans(new, {name: running(fleet(), name) for name in new.nodes})
    away = {name: NodePlan(name, Verdict.AWAY, reason="did not answer") for name in more}
    plan = fleet_plan(large, {**made, **away}, STAR, now_s=0.0)
    assert "would leave behind 75 nodes (h00, h01, h02, h03 and 71 more): unreachable" in plan.refusal
    assert "h00" not in plan.refusal_hint
    refused = {name: NodePlan(name, Verdict.REFUSED, reason="it has no port eth1") for name in more}
    plan = fleet_plan(large, {**made, **refused}, STAR, now_s=0.0)
    assert plan.refusal.endswith("can take part: 75 nodes (h00, h01, h02, h03 and 71 more): it has no port eth1")
