"""Power cuts of nodes in the machine: they get radios and cables back, whatever else remains of them."""

from __future__ import annotations

import random

import pytest

from meshlab.placement import flush_stations
from meshlab.qemu import control
from tests.meshlab.power_cycles import cycle
from tests.meshlab.qemu.conftest import WAIT_S, Lab

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]


def test_a_node_boots_while_its_old_network_namespace_is_still_in_use(lab: Lab) -> None:
    """A connection that retransmits its FIN keeps a dead node's network namespace for up to two minutes."""
    (pid,) = (node["pid"] for node in lab.fleet.status()["nodes"] if node["name"] == "b02")
    keep = f"sleep 1000 </proc/{pid}/ns/net >/dev/null 2>&1 & echo $!"
    keeper = control.run(lab.fleet.directory, keep).check("keep the network").stdout.strip()
    try:
        lab.node("b02").power_cut(back=False)
        # else they are half deaf to it for minutes: it is back before Linux drops their entries
        flush_stations(lab.fleet, "b02")
        # it fails only if it has not booted in time
        lab.node("b02").power_on(wait_s=WAIT_S)
        assert lab.node("b02").is_up()
        kept = control.run(lab.fleet.directory, f"readlink /proc/{keeper}/fd/0").check("it is still kept").stdout
        assert kept.startswith("net:")
    finally:
        control.run(lab.fleet.directory, f"kill {keeper}")
    lab.settle()


def test_no_two_nodes_have_a_process_with_the_same_id(lab: Lab) -> None:
    """Otherwise an `iw` on one node ends the mesh that wpa_supplicant runs on another: see container.last_pid."""
    starts = {name: int(lab.node(name).exec("sh -c 'echo $$'").stdout) >> 16 for name in lab.NODES}
    assert len(set(starts.values())) == len(lab.NODES), starts


@pytest.mark.proof
@pytest.mark.timeout(7200)
def test_every_node_survives_two_hundred_power_cycles(lab: Lab) -> None:
    assert list(cycle(lab.fleet, lab.NODES, 200, random.Random(1), wait_s=WAIT_S, met=lab.meet))
    lab.settle()
