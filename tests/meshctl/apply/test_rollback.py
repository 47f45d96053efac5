"""What a rollback writes back, and what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from meshctl.apply.rollback import EarlierState, EarlierStates, before_state, irreversible, without_undone
from meshctl.fleet import Outcome, Result
from meshctl.nodes.desired import Renderer
from meshctl.plan import Verdict, node_plan
from tests.meshctl.plan.support import FINGERPRINTS, PASS_PHRASE, fleet, running, secret, wanted

DONE = Outcome("b01", Result.DONE)


def recorded() -> EarlierState:
    """b01 before a run that moves it from channel 6 to 11, through the file."""
    new, seen = wanted(fleet(channel=11), "b01"), running(fleet(), "b01")
    state = before_state(node_plan(new, seen, FINGERPRINTS), new, seen)
    return EarlierState.from_json(json.loads(json.dumps(state.to_json())))


def refusal(state: EarlierState | None = None, outcome: Outcome = DONE, later: tuple[int, ...] = ()) -> str:
    return irreversible(7, fleet().nodes["b01"], outcome, state or recorded(), later)


def test_a_rollback_plan_restores_exactly_the_earlier_files() -> None:
    now_fleet = fleet(channel=11)
    old = wanted(fleet(), "b01")
    renderer = Renderer.of(now_fleet, secret)
    earlier = EarlierStates(now_fleet, renderer.secrets, renderer.templates, {"b01": recorded()})
    back = earlier.desired(now_fleet.nodes["b01"])
    assert {file.path: file.content for file in back.files} == {file.path: file.content for file in old.files}
    plan = node_plan(back, running(now_fleet, "b01"), FINGERPRINTS)
    assert plan.verdict is Verdict.CHANGE
    assert "channel '6'" in "".join(change.diff for change in plan.files)
    # another cell: the plan knows that it partitions the mesh, and leads away from members in the inventory's cell
    assert (bool(plan.splits), plan.departs) == (True, ("main",))
    reverted = EarlierStates(fleet(), renderer.secrets, renderer.templates, {"b01": recorded()})
    assert reverted.desired(fleet().nodes["b01"]).departs == ()
    assert node_plan(back, running(fleet(), "b01"), FINGERPRINTS).verdict is Verdict.SAME
    # nodes that the run did not change are those of the inventory
    assert earlier.desired(now_fleet.nodes["b02"]).files == wanted(now_fleet, "b02").files


def test_secrets_are_written_back_and_never_shown() -> None:
    renderer = Renderer.of(fleet(), secret)
    back = EarlierStates(fleet(), renderer.secrets, renderer.templates, {"b01": recorded()}).desired(
        fleet().nodes["b01"]
    )
    wireless = next(file for file in back.files if file.path == "etc/config/wireless")
    assert PASS_PHRASE in wireless.content.decode()
    assert PASS_PHRASE in back.secrets
    assert PASS_PHRASE not in wireless.masked


def test_a_reversible_run_is_rolled_back() -> None:
    assert refusal() == ""


@pytest.mark.parametrize(
    ("state", "outcome", "later", "why"),
    [
        (None, replace(DONE, result=Result.UNCERTAIN), (), "the outcome of run 7 is uncertain"),
        (None, DONE, (8, 12), "run 12 changed it later: run `meshctl rollback 12` first"),
        (replace(recorded(), lasting="flashed its firmware"), DONE, (), "run 7 flashed its firmware, which no"),
        (replace(recorded(), added=("etc/config/x",)), DONE, (), "run 7 created /etc/config/x, which would stay"),
    ],
)
def test_an_irreversible_run_is_rejected(
    state: EarlierState | None, outcome: Outcome, later: tuple[int, ...], why: str
) -> None:
    assert refusal(state, outcome, later).startswith(why)


def test_a_run_that_was_rolled_back_is_not_rolled_forward() -> None:
    node = fleet().nodes["b01"]
    assert irreversible(7, node, DONE, recorded(), (8,), {8}) == "run 8 has rolled it back already"
    # a change after that
    assert "run `meshctl rollback 9` first" in irreversible(7, node, DONE, recorded(), (8, 9), {8})


def test_a_node_without_a_record_or_unmanaged_is_refused() -> None:
    assert "not recorded" in irreversible(7, fleet().nodes["b01"], DONE, None, ())
    assert "no longer manages" in irreversible(7, None, DONE, recorded(), ())


def test_a_rollback_to_a_different_address_is_rejected() -> None:
    state = recorded()
    files = tuple(replace(file, text=(file.text or "").replace("10.42.0.101", "10.42.0.99")) for file in state.files)
    assert "its address was 10.42.0.99" in refusal(replace(state, files=files))


def test_a_file_with_undecodable_bytes_is_not_restored() -> None:
    state = recorded()
    new = wanted(fleet(channel=11), "b01")
    seen = running(fleet(), "b01")
    seen = replace(seen, uci={**(seen.uci or {}), "system": "config system\n\toption hostname 'b\ufffd'\n"})
    inexact = before_state(node_plan(new, seen, FINGERPRINTS), new, seen)
    assert "/etc/config/system" in refusal(inexact)
    assert state.files


def test_rolled_back_runs_do_not_block_a_rollback() -> None:
    assert without_undone([(8, None), (9, 8)]) == ()
    assert without_undone([(8, None), (9, None), (10, 9)]) == (8,)
    # rolling back a rollback applies the run again
    assert without_undone([(8, None), (9, 8), (10, 9)]) == (10,)
