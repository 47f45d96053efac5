"""The comparison of the mission: the legacy transport carries it where nothing is lost, and its bytes are counted."""

from __future__ import annotations

import os
from typing import Any

import pytest

from benchmarks.exploration.__main__ import LEGACY, UDP_MESH, measure, table
from tests.udp_mesh.bridges.interpreters import expects_ros

pytestmark = [
    pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root"),
    pytest.mark.skipif(not expects_ros(), reason="needs scripts/setup-ros"),
    pytest.mark.xdist_group("ros1"),
]


def test_the_legacy_transport_carries_the_mission_on_a_link_without_loss() -> None:
    done = measure(LEGACY, 2, 0.0, cut_s=0.0, limit_s=60.0)
    assert [phase["phase"] for phase in done["phases"]] == ["connect", "cut", "home", "meet again"]
    assert all(phase["is_done"] for phase in done["phases"])
    assert done["items_at_base"] == done["items"] == 14
    assert done["task_known_as_taken"]
    # six artifacts and map differences before the cut, eight during it, in base64
    assert done["bytes"] > (7 * 30_000 + 7 * 20_000) * 4 / 3


def run(transport: str, home_s: float, *, is_done: bool) -> dict[str, Any]:
    phases = [
        {"phase": name, "is_done": is_done or name != "home", "seconds": seconds}
        for name, seconds in (("connect", 3.0), ("cut", 120.0), ("ferry home", 1.0), ("home", home_s))
    ]
    return {
        "transport": transport,
        "masters": 3,
        "loss": 0.05,
        "phases": phases,
        "items": 20,
        "items_at_base": 20 if is_done else 7,
        "task_known_as_taken": is_done,
        "bytes": 1_230_000,
    }


def test_a_row_has_medians_and_says_what_was_given_up() -> None:
    runs = [run(LEGACY, home_s, is_done=home_s < 60.0) for home_s in (60.0, 20.0, 60.0)]
    assert table([*runs, run(UDP_MESH, 2.0, is_done=True)]).splitlines()[2:] == [
        "| 3 | 5% | udp_mesh | 1 | 3 s | 3 s | 20 of 20 | 1 of 1 | 1.2 |",
        "| 3 | 5% | legacy transport | 3 | 3 s | 61 s, given up in 2 of 3 | 7 of 20 | 1 of 3 | 1.2 |",
    ]
