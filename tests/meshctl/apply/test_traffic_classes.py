"""Stale station entries that drop what a node's SSH server sends, but no replies to echo requests, and the reverse.

Seen on real OpenWrt: each traffic class has a block acknowledgment window of its own (finding 25 of
docs/facts/node-assumptions.md). The node is reached over the mesh alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from meshctl.model import Release
from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("logins")]


@pytest.fixture(params=["logins", "ordinary"])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    # its radios keep their address when they restart
    with Rig(tmp_path / "rig", count=1, window_s=60, release=Release.V22_03, stale=(request.param,)) as made:
        assert made.take_in("a").code == 0
        made.fleet.node("n001").plug(False)
        yield made


def test_a_good_change_of_radio_and_network_is_not_undone(rig: Rig) -> None:
    """A change of the network may drop logins: its neighbors were content with echo replies until it was undone."""
    ended = rig.meshctl("provision", "b", "n001", "--yes", "--json")
    assert ended.results == {"n001": "done"}, ended.out + ended.err
    assert rig.state_of("n001", "a", "b") == "new"


def test_a_change_that_locks_out_is_undone_and_the_node_reached_again(rig: Rig) -> None:
    text = rig.inventory("a").read_text(encoding="utf-8")
    locked = text.replace("defaults: {", "defaults: {extra_uci: {firewall.management.input: DROP}, ")
    rig.inventory("locked").write_text(locked.replace("distance_m: 1000", "distance_m: 1002"), encoding="utf-8")
    ended = rig.meshctl("provision", "locked", "n001", "--yes", "--json")
    assert ended.results == {"n001": "rolled back"}, ended.out + ended.err
    again = rig.meshctl("provision", "b", "n001", "--yes", "--json")
    assert again.results == {"n001": "done"}, again.out + again.err
