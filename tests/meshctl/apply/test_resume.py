"""A resume reports what became of every uncertain node."""

from __future__ import annotations

from dataclasses import replace
from types import MappingProxyType

import pytest

from meshctl.apply.participant import LEFT_BEHIND
from meshctl.apply.prepare import Prepared
from meshctl.apply.resume import resolutions
from meshctl.device.observation import ChangeStatus
from meshctl.fleet import Outcome, Result
from meshctl.nodes.collect import FleetObservation
from meshctl.plan import NodePlan, Plan, Verdict
from tests.meshctl.plan.support import fleet, running


def prepared(verdict: Verdict) -> Prepared:
    plan = Plan("team", 0.0, ("base",), MappingProxyType({"b01": NodePlan("b01", verdict, "no board")}))
    change = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="timeout")
    return Prepared(plan, {}, FleetObservation({"b01": replace(running(fleet(), "b01"), change=change)}, {}))


@pytest.mark.parametrize(
    ("verdict", "text"),
    [
        (Verdict.SAME, "now it matches the inventory"),
        (Verdict.CHANGE, "now it runs its previous state (it was not confirmed in time) and will change again"),
        (Verdict.REFUSED, "now it answers and is refused: no board"),
        (Verdict.AWAY, "now it is still unreachable"),
    ],
)
def test_each_resolution_of_an_uncertain_node_is_reported(verdict: Verdict, text: str) -> None:
    resolved = resolutions(7, [Outcome("b01", Result.UNCERTAIN, "left")], prepared(verdict))
    assert resolved == {"b01": f"uncertain after run 7; {text}"}


def test_a_node_left_in_the_old_cell_is_reported_with_how_to_reach_it() -> None:
    left = Outcome("b01", Result.UNCERTAIN, facts={LEFT_BEHIND: "radio0: channel 6 -> 11"})
    assert resolutions(7, [left], prepared(Verdict.AWAY))["b01"].endswith(
        "still unreachable: it is still in the old cell of its mesh (radio0: channel 6 -> 11); "
        "reach it by cable or from another node in that cell"
    )


def test_only_uncertain_nodes_in_the_plan_are_reported() -> None:
    assert (
        resolutions(7, [Outcome("b01", Result.FAILED), Outcome("b09", Result.UNCERTAIN)], prepared(Verdict.SAME)) == {}
    )
