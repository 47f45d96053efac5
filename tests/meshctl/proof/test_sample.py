"""A small, fixed sample of the kill matrix over a virtual fleet; `python -m tests.meshctl.proof` runs all of it."""

from __future__ import annotations

import pytest

from tests.meshctl.proof.kills import strike_meshctl, strike_nodes
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("fleet")]


def test_after_a_cut_every_node_is_old_or_new_and_a_resume_finishes(rig: Rig) -> None:
    old, new = rig.flip()
    steps = {
        "n001": "mv -f /etc/meshctl/change",
        "n002": "reload_config",
        "n003": "tar -xzf",
        "n004": "confirmed",
    }
    cases = strike_nodes(rig, steps, "power-cut", old=old, new=new)
    assert [case.object() for case in cases if not (case.holds and case.struck)] == []


def test_after_meshctl_was_killed_every_node_is_old_or_new_and_a_resume_finishes(rig: Rig) -> None:
    old, new = rig.flip()
    cases = strike_meshctl(rig, words=14, old=old, new=new)
    assert [case.object() for case in cases if not case.holds] == []


@pytest.mark.proof
def test_a_failed_switch_rolls_back_the_whole_mesh_and_is_resumed(rig: Rig) -> None:
    everybody = ("base", *rig.names)
    rig.fleet.inject_fault("base", "power-cut@reload_config")
    failed = rig.meshctl("provision", "split", "--yes", "--json")
    rig.fleet.repair("base")
    assert set(failed.results.values()) == {"rolled back"}, failed.out
    assert {rig.state_of(name, rig.current, "split") for name in everybody} == {"old"}
    ended = rig.meshctl("resume", "split", "--yes", "--json")
    assert (ended.code, set(ended.results.values())) == (0, {"done"}), ended.out + ended.err
    assert {rig.state_of(name, rig.current, "split") for name in everybody} == {"new"}
    # On the way back one node is left behind: it is reported as uncertain, and a resume settles it.
    rig.fleet.inject_fault("n001", "sever@mv -f /etc/meshctl/change/new")
    ended = rig.meshctl("provision", "a", "--yes", "--json")
    expected = {name: "uncertain" if name == "n001" else "done" for name in ("base", *rig.names)}
    assert ended.results == expected, ended.out
    (left,) = (event["text"] for event in ended.events if event["event"] == "note" and event["node"] == "n001")
    assert "last seen" in left
    rig.fleet.repair("n001")
    resumed = rig.meshctl("resume", "a", "--yes")
    assert "n001: uncertain after run" in resumed.out
    assert "it runs its previous state" in resumed.out
    assert resumed.code == 0, resumed.out + resumed.err
    assert rig.state_of("n001", "split", "a") == "new"
    rig.current = "a"
