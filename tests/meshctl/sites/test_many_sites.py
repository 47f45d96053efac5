"""Many sites over NATS whose uplinks come and go: a small show in every run of the tests, the large one as a proof."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.meshctl.sites.many_sites import run_show
from tests.meshctl.sites.nats_rig import NatsRig
from tests.meshctl.sites.recorded_site import expected_result, kind_of, recordings

pytestmark = [pytest.mark.xdist_group("nats")]
_SEED = 1


def _names(count: int) -> list[str]:
    return [f"s{number:02}" for number in range(1, count + 1)]


def test_four_sites_of_five_nodes_end_right(tmp_path: Path) -> None:
    with NatsRig(tmp_path, dict.fromkeys(_names(4), 5), with_lab=False) as rig:
        ended = run_show(rig, _SEED, wait_s=400)
    assert ended.outcomes.total() == 20


@pytest.mark.lab
@pytest.mark.proof
@pytest.mark.timeout(3600)
def test_forty_sites_of_fifty_nodes_end_right(tmp_path: Path) -> None:
    """Two sites of virtual nodes, eight with a virtual base; all other nodes are recordings of several kinds."""
    with NatsRig(tmp_path, dict.fromkeys(_names(38), 50), virtual_bases=8) as rig:
        ended = run_show(rig, _SEED, wait_s=2400)
    assert ended.outcomes.total() == 38 * 50 + 4
    assert ended.cuts > 38


def test_recorded_nodes_are_of_several_kinds() -> None:
    names = [f"s{site:02}-n{number:02}" for site in range(1, 39) for number in range(1, 50)]
    kinds = Counter(kind_of(name) for name in names)
    assert set(kinds) == {"", *recordings()} - {"base"}
    results = Counter(expected_result(name) for name in names)
    assert set(results) >= {"done", "unreachable", "unchanged", "refused"}
    assert results["done"] > len(names) // 2
