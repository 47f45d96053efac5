"""A node whose SSH server accepts connections and stays silent: its neighbors are not asked to repair links to it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs"), pytest.mark.timeout(600)]


@pytest.fixture
def rig(rig: Rig) -> Iterator[Rig]:
    rig.fleet.inject_fault("n001", "ssh-hang")
    yield rig
    rig.fleet.repair("n001")


def test_a_silent_server_is_not_taken_for_a_stale_station_entry(rig: Rig) -> None:
    ended = rig.meshctl("provision", rig.current, "n001", "--yes", "--json")
    assert ended.results == {"n001": "unreachable"}, ended.out + ended.err
    assert "no answer to the SSH handshake" in ended.out
    assert "repairs its links" not in ended.out + ended.err
