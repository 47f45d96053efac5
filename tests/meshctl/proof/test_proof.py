"""The long proofs: the whole kill matrix of apply and flash, and 200 nodes of which some fail."""

from __future__ import annotations

import pytest

from tests.meshctl.proof.crowd import hurt_and_provision
from tests.meshctl.proof.kills import Case
from tests.meshctl.proof.matrix import apply_matrix, firmware, flash_matrix, kill_matrix
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("rigs"), pytest.mark.timeout(6 * 3600)]


def test_no_cut_at_any_step_of_an_apply_strands_a_node(tmp_path_factory: pytest.TempPathFactory) -> None:
    bad: list[Case] = []
    with Rig(tmp_path_factory.mktemp("apply"), 8) as rig:
        assert rig.take_in("a").code == 0
        apply_matrix(rig, lambda case, phase, batch: None if case.holds else bad.append(case))
    assert bad == []


def test_killing_meshctl_at_any_event_strands_no_node(tmp_path_factory: pytest.TempPathFactory) -> None:
    bad: list[Case] = []
    with Rig(tmp_path_factory.mktemp("kill"), 8) as rig:
        assert rig.take_in("a").code == 0
        kill_matrix(rig, lambda case, phase, batch: None if case.holds else bad.append(case))
    assert bad == []


def test_no_cut_at_any_step_of_a_flash_strands_a_node(tmp_path_factory: pytest.TempPathFactory) -> None:
    bad: list[Case] = []
    directory = tmp_path_factory.mktemp("flash")
    with Rig(directory, 8, firmware=firmware(directory)) as rig:
        assert rig.take_in("a").code == 0
        flash_matrix(rig, lambda case, phase, batch: None if case.holds else bad.append(case))
    assert bad == []


def test_killing_meshctl_at_any_event_of_a_flash_strands_no_node(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    bad: list[Case] = []
    directory = tmp_path_factory.mktemp("flash-kill")
    with Rig(directory, 2, firmware=firmware(directory)) as rig:
        assert rig.take_in("a").code == 0
        kill_matrix(rig, lambda case, phase, batch: None if case.holds else bad.append(case), verb="flash")
    assert bad == []


def test_every_outcome_of_200_nodes_with_faults_is_right_and_none_is_lost(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    with Rig(tmp_path_factory.mktemp("crowd"), 200) as rig:
        assert rig.take_in("a").code == 0
        report = hurt_and_provision(rig, share=0.05, old="a", new="b")
    assert (report["wrong"], report["not new"]) == ({}, {})
