"""Discovery on the wire: the members of a team find each other, and what they send is counted."""

from __future__ import annotations

import os

import pytest

from benchmarks.discovery_traffic import KINDS, measure, table

pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="network namespaces need root")


def test_a_team_of_udp_mesh_finds_itself_and_its_datagrams_are_counted() -> None:
    seen = measure("udp-mesh", 3, min_start_s=0.0, settle_s=0.0, rest_s=2.0)
    assert seen["known_s"] is not None
    # each has sent at least one heartbeat
    assert seen["start_frames"] >= 3
    assert seen["start_bytes"] > 40 * seen["start_frames"]
    assert seen["frames_per_minute"] > 0
    assert f"| 3 | {KINDS['udp-mesh']} | 0 |" in table([seen])
