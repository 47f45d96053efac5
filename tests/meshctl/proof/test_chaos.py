"""Random faults and operators from a seed: every node runs what the model says, and nothing is left behind."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from tests.meshctl.proof.chaos import (
    KEPT,
    MEANING,
    Model,
    Operator,
    Ran,
    Round,
    at_rest,
    leftovers,
    play,
    rounds_of,
    split_mesh,
    state_in,
    uploads,
)
from tests.meshctl.proof.rig import VARIANTS, Ended, Rig

NODES, ROUNDS, SEEDS = 6, 6, (20, 21, 22)
# whose first round changes the cell, loses a node's power and backs all nodes up at once
SAMPLE_SEED = 1206
PROVISION = Operator("provision")


def ended(**results: str) -> Ended:
    outcomes = ", ".join(f'{{"node": "{name}", "result": "{result}"}}' for name, result in results.items())
    return Ended(0, f'{{"event": "ended", "outcomes": [{outcomes}]}}\n', "")


def test_a_schedule_follows_from_its_seed() -> None:
    names = ("n001", "n002", "n003")
    assert rounds_of(1, names, 20) == rounds_of(1, names, 20) != rounds_of(2, names, 20)
    everything = rounds_of(1, names, 200)
    assert {len(one.operators) for one in everything} == {1, 2}
    assert {operator.verb for one in everything for operator in one.operators} == {
        "provision",
        "resume",
        "backup",
        "restore",
    }
    assert {strike.node for one in everything for strike in one.strikes} == set(names)
    targets = ["a", *(one.target for one in everything)]
    assert set(targets) == set(VARIANTS)
    assert all(before != after for before, after in pairwise(targets))


def test_the_model_tracks_the_states_each_outcome_allows() -> None:
    model = Model({name: frozenset("a") for name in ("done", "back", "lost", "both")})
    run = ended(done="done", back="rolled back", lost="uncertain", both="refused")
    model.update([Ran(PROVISION, "b", run), Ran(PROVISION, "b", None)])
    # a killed operator may have changed any of them
    assert model.may_run == {name: frozenset("ab") for name in model.may_run} | {"done": frozenset("b")}
    model.update([Ran(PROVISION, "a", ended(done="refused", back="done", lost="unchanged", both="refused"))])
    assert model.may_run == {
        "done": frozenset("b"),
        "back": frozenset("a"),
        "lost": frozenset("a"),
        "both": frozenset("ab"),
    }


def test_a_backup_changes_no_node_and_a_restore_only_its_own() -> None:
    model = Model({"n001": frozenset("a"), "n002": frozenset("a")})
    model.update([Ran(Operator("backup"), "b", None), Ran(Operator("restore", node="n001"), "b", None)])
    assert model.may_run == {"n001": frozenset("ab"), "n002": frozenset("a")}
    model.update(
        [Ran(PROVISION, "split", ended(n001="done")), Ran(Operator("restore", node="n001"), "a", ended(n001="done"))]
    )
    # whichever came last; the provisioning has not begun with the other one
    assert model.may_run == {"n001": frozenset({"split", "a"}), "n002": frozenset("a")}


def test_a_mesh_changes_its_cell_with_a_quorum_and_the_base_or_not_at_all() -> None:
    before = {"base": "a", "n001": "a", "n002": "b", "n003": "split"}
    assert split_mesh(before, "split", ended(base="done", n001="done", n002="uncertain", n003="unchanged")) == ""
    assert split_mesh(before, "split", ended(base="rolled back", n001="rolled back", n002="uncertain")) == ""
    assert "1 of 3 nodes" in split_mesh(before, "split", ended(base="done", n001="uncertain", n002="rolled back"))
    assert "2 of 3 nodes" in split_mesh(before, "split", ended(base="rolled back", n001="done", n002="done"))
    # the cell of most is kept, so each changes alone
    assert split_mesh(before, "b", ended(base="done", n001="failed", n002="unchanged", n003="done")) == ""


def test_the_model_knows_every_result() -> None:
    from meshctl.fleet import Result

    assert {result.value for result in Result} == set(MEANING)


def test_uploads_timers_and_backups_count_as_left_behind() -> None:
    assert [
        name
        for name in ("c0ffee01.tgz", "change-c0ffee01", "backup.812", "lock.7", "pause", "reload.log")
        if not KEPT.fullmatch(name)
    ] == ["c0ffee01.tgz", "change-c0ffee01", "backup.812"]


@pytest.mark.lab
@pytest.mark.xdist_group("fleet")
def test_a_sample_round_ends_in_a_state_that_the_model_allows(rig: Rig) -> None:
    names = ("base", *rig.names)
    (round_,) = rounds_of(SAMPLE_SEED, rig.names, 1)
    assert (round_.target, [operator.verb for operator in round_.operators]) == ("split", ["provision", "backup"])
    _check_round(rig, Model({name: frozenset(rig.current) for name in names}), str(round_), round_)
    back = rig.meshctl("provision", rig.current, "--yes", "--json")
    assert set(back.results.values()) <= {"done", "unchanged"}, back.out + back.err
    assert leftovers(rig, names) == {}


@pytest.mark.proof
@pytest.mark.lab
@pytest.mark.xdist_group("fleet")
@pytest.mark.timeout(3 * 3600)
@pytest.mark.parametrize("seed", SEEDS)
def test_no_schedule_strands_a_node_or_leaves_files_behind(seed: int, tmp_path: Path) -> None:
    with Rig(tmp_path / "rig", NODES) as rig:
        assert rig.take_in("a").code == 0
        names = ("base", *rig.names)
        model = Model({name: frozenset("a") for name in names})
        rounds = rounds_of(seed, rig.names, ROUNDS)
        for number, round_ in enumerate(rounds):
            _check_round(rig, model, f"seed {seed}, round {number}: {round_}", round_)
        last = rounds[-1].target
        # the second run changes every node
        for target in (last, "b" if last == "a" else "a"):
            finished = rig.meshctl("provision", target, "--yes", "--json")
            assert set(finished.results.values()) <= {"done", "unchanged"}, finished.out + finished.err
            assert {name: rig.variant_of(name) for name in names} == dict.fromkeys(names, target)
        assert leftovers(rig, names) == {}


def _check_round(rig: Rig, model: Model, label: str, round_: Round) -> None:
    before = {name: variant for name, (variant,) in model.may_run.items()}
    backups = rig.directory / "backups"
    had = set(backups.glob("*"))
    ran = play(rig, round_, backups)
    model.update(ran)
    states = at_rest(rig, model.may_run)
    assert set(states.values()) <= {"idle", "staged"}, f"{label}: {states}"
    assert uploads(rig, states) == {}, label
    for name, allowed in model.may_run.items():
        runs = rig.variant_of(name)
        assert runs in allowed, f"{label}: {name} runs {runs}, the model allows {sorted(allowed)}"
        model.may_run[name] = frozenset({runs})
    for each in ran:
        assert each.ended is None or "Traceback" not in each.ended.err, f"{label}: {each.ended.err}"
    if len(ran) == 1 and ran[0].ended is not None:
        assert split_mesh(before, round_.target, ran[0].ended) == "", label
    for file in set(backups.glob("*.tgz")) - had:
        # of a state that was confirmed
        name, state = file.name.split("-")[0], state_in(rig, file)
        assert {state} <= {before[name]} | model.may_run[name], f"{label}: {file.name} is of {state}"
