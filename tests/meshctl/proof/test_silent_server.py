"""A node whose SSH server accepts connections and stays silent: its neighbors are not asked to repair links to it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.rig import Rig
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("rigs")]


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


# what a neighbor sees of a connection to it within a minute, and what its server says
LOOK = """nc 10.42.1.1 22 </dev/null >/tmp/said &
until netstat -tn | grep -F '10.42.1.1:22 '; do :; done
kill $!
cat /tmp/said"""


def test_a_neighbor_sees_its_connection_accepted_and_no_banner(rig: Rig) -> None:
    base = rig.fleet.node("base")
    until(lambda: "hangs" in base.exec("grep -F 10.42.1.1 /lab/node/air/heard").stdout, "the mesh to know it")
    assert base.exec(LOOK).stdout.split()[-1] == "ESTABLISHED"
