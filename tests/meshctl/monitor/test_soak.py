"""Memory stays flat, however long the monitor runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.monitor_soak import INTERVAL_S, report, soak


@pytest.mark.proof
def test_an_hour_against_200_radios_needs_no_more_memory_than_its_first_minutes(tmp_path: Path) -> None:
    found = soak(tmp_path, radios=200, robots=20, rounds=round(3600 / INTERVAL_S))
    settled = found.rss_mib[2]
    assert max(found.rss_mib[3:]) - settled < 10, found.rss_mib
    assert found.frames == 720


def test_the_simulated_fleet_breaks_down_and_is_recorded(tmp_path: Path) -> None:
    found = soak(tmp_path, radios=12, robots=3, rounds=30, samples=2)
    assert found.frames == 30
    assert found.alarms > 0
    assert found.frame_kib > 10
    row = {name: getattr(found, name) for name in found.__dataclass_fields__}
    assert f"| {found.radios} | {found.robots} | 30 |" in report([row])
