"""A node that moves to another mesh and address in the inventory is changed over the mesh in which it answers."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.meshctl.proof.rig import Rig

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]

MOVED = """\
  n001: {address: 10.43.1.1, radios: {radio0: {mesh: second}}}
"""
SECOND = """\
meshes:
  second: {ssid: second, bssid: "02:ca:fe:00:00:02", band: 2g, channel: 11, network: 10.43.0.0/16}
"""


@pytest.fixture
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with Rig(tmp_path_factory.mktemp("moved"), 1, window_s=100) as started:
        # alone: the proof of a change asks for half of the former neighbors, and the second mesh has no other node
        started.fleet.link("base", "n001", up=False)
        taken = started.take_in("a")
        assert (taken.code, set(taken.results.values())) == (0, {"done"}), taken.out + taken.err
        yield started


def test_a_node_moves_to_another_mesh_and_back(rig: Rig) -> None:
    text = rig.inventory("a").read_text(encoding="utf-8")
    rig.inventory("moved").write_text(
        text.replace("meshes:\n", SECOND).replace("nodes:\n", f"nodes:\n{MOVED}"), encoding="utf-8"
    )
    for variant, address, former in (("moved", "10.43.1.1", "10.42.1.1"), ("a", "10.42.1.1", "10.43.1.1")):
        plan = rig.meshctl("plan", variant, "n001")
        assert f"it is reached at {former}" in plan.out, plan.out + plan.err
        assert ("in the network of mesh main" in plan.out) == (variant == "moved")
        ended = rig.meshctl("provision", variant, "n001", "--yes", "--json")
        assert ended.results == {"n001": "done"}, ended.out + ended.err
        shown = rig.fleet.node("n001").exec("uci get network.lan.ipaddr").stdout
        assert shown.strip() == address
        assert "it is reached at" not in rig.meshctl("plan", variant, "n001").out
