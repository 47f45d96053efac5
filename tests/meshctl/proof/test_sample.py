"""A small, fixed sample of the kill matrix over a real virtual fleet; `python -m tests.meshctl.proof` runs all of it.

One fleet serves all tests of this file, in their order: each takes it from one inventory to another.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.kills import strike_meshctl, strike_nodes
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab"), pytest.mark.timeout(600)]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("proof"), 4) as started:
        yield started


def test_factory_devices_become_a_fleet_and_a_second_look_finds_nothing_to_do(rig: Rig) -> None:
    taken = rig.take_in("a")
    assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.err
    again = rig.meshctl("provision", "a", "--check", "--json")
    assert (again.code, set(again.verdicts.values())) == (0, {"same"}), again.err


def test_after_a_cut_every_node_is_old_or_new_and_a_resume_finishes(rig: Rig) -> None:
    steps = {
        "n001": "mv -f /etc/meshctl/change",
        "n002": "reload_config",
        "n003": "tar -xzf",
        "n004": "confirmed",
    }
    cases = strike_nodes(rig, steps, "power-cut", old="a", new="b")
    assert [case.object() for case in cases if not case.holds] == []


def test_after_meshctl_was_killed_every_node_is_old_or_new_and_a_resume_finishes(rig: Rig) -> None:
    cases = strike_meshctl(rig, words=14, old="b", new="a")
    assert [case.object() for case in cases if not case.holds] == []


def test_a_whole_mesh_changes_its_channel_at_one_moment(rig: Rig) -> None:
    ended = rig.meshctl("provision", "split", "--yes", "--json")
    assert (ended.code, set(ended.results.values())) == (0, {"done"}), ended.err
    assert {rig.state_of(name, "a", "split") for name in ("base", *rig.names)} == {"new"}


def test_a_mesh_whose_base_is_cut_off_goes_back_to_its_channel_as_a_whole(rig: Rig) -> None:
    rig.fleet.break_("base", "power-cut@reload_config")
    ended = rig.meshctl("provision", "a", "--yes", "--json")
    rig.fleet.mend("base")
    assert set(ended.results.values()) == {"rolled back"}, ended.out
    assert {rig.state_of(name, "split", "a") for name in ("base", *rig.names)} == {"old"}
