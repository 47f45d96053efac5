"""Random faults and operators from a seed: every node runs what the model says, and nothing is left behind."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.meshctl.proof.chaos import MEANING, Model, Round, at_rest, leftovers, play, rounds_of
from tests.meshctl.proof.rig import Ended, Rig

NODES, ROUNDS, SEEDS = 6, 6, (20, 21, 22)


def ended(**results: str) -> Ended:
    outcomes = ", ".join(f'{{"node": "{name}", "result": "{result}"}}' for name, result in results.items())
    return Ended(0, f'{{"event": "ended", "outcomes": [{outcomes}]}}\n', "")


def test_a_schedule_follows_from_its_seed() -> None:
    names = ("n001", "n002", "n003")
    assert rounds_of(1, names, 20) == rounds_of(1, names, 20) != rounds_of(2, names, 20)
    everything = rounds_of(1, names, 200)
    assert {len(one.kills) for one in everything} == {1, 2}
    assert {strike.node for one in everything for strike in one.strikes} == set(names)


def test_the_model_tracks_the_states_each_outcome_allows() -> None:
    model = Model({name: frozenset("a") for name in ("done", "back", "lost", "both")})
    model.update("b", [ended(done="done", back="rolled back", lost="uncertain", both="refused"), None])
    # a killed operator may have changed any of them
    assert model.may_run == {name: frozenset("ab") for name in model.may_run} | {"done": frozenset("b")}
    model.update("a", [ended(done="refused", back="done", lost="unchanged", both="refused")])
    assert model.may_run == {
        "done": frozenset("b"),
        "back": frozenset("a"),
        "lost": frozenset("a"),
        "both": frozenset("ab"),
    }


def test_the_model_knows_every_result() -> None:
    from meshctl.fleet import Result

    assert {result.value for result in Result} == set(MEANING)


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
        for number, round_ in enumerate(rounds_of(seed, rig.names, ROUNDS)):
            _check_round(rig, model, f"seed {seed}, round {number}: {round_}", "ba"[number % 2], round_)
        target = "ba"[ROUNDS % 2]
        finished = rig.meshctl("provision", target, "--yes", "--json")
        assert set(finished.results.values()) <= {"done", "unchanged"}, finished.out
        assert {name: rig.state_of(name, "ab".replace(target, ""), target) for name in names} == dict.fromkeys(
            names, "new"
        )
        assert leftovers(rig, names) == {}


def _check_round(rig: Rig, model: Model, label: str, target: str, round_: Round) -> None:
    model.update(target, play(rig, target, round_))
    states = at_rest(rig, model.may_run)
    assert set(states.values()) <= {"idle", "staged"}, f"{label}: {states}"
    other = "ab".replace(target, "")
    for name, allowed in model.may_run.items():
        runs = {"new": target, "old": other}.get(rig.state_of(name, other, target), "a mixture")
        assert runs in allowed, f"{label}: {name} runs {runs}, the model allows {sorted(allowed)}"
        model.may_run[name] = frozenset(runs)
