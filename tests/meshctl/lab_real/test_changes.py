"""Changing a mesh of real radios over that mesh itself: order, switch, undo, cuts."""

from __future__ import annotations

import pytest

from tests.meshctl.lab_real.conftest import NODES, Lab, until

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]


def cells(lab: Lab) -> set[str]:
    """The cells the kernels' radios are in: frequency and BSSID."""
    command = "iw dev mesh0 link | sed -n -e 's/^Joined IBSS \\([^ ]*\\).*/\\1/p' -e 's/^.freq: //p'"
    return {" ".join(lab.on(name, command).split()) for name in NODES}


def test_a_whole_mesh_changes_channel_and_bssid_over_itself(lab: Lab) -> None:
    assert cells(lab) == {"02:ca:fe:00:00:01 2437"}
    lab.edit("channel: 6\n", "channel: 11\n")
    lab.edit("02:ca:fe:00:00:01", "02:ca:fe:00:00:11")
    last = lab.provision()[-1]
    assert {event["outcome"]["result"] for event in last if event["event"] == "finished"} == {"done"}
    assert cells(lab) == {"02:ca:fe:00:00:11 2462"}
    lab.settle()


def test_the_mesh_goes_back_when_some_of_it_never_arrives(lab: Lab) -> None:
    before = cells(lab)
    lab.edit("channel: 11\n", "channel: 1\n")
    # nobody waits long for what will not come
    lab.edit("confirm_window_s: 600", "confirm_window_s: 61")
    # at the moment of the switch b02 hears nobody any more, and the Husky nobody but itself
    lab.fleet.break_("b02", "sever@reload_config")
    done = lab.meshctl("provision", "--yes", "--json", expect=1)
    results = {event["node"]: event["outcome"]["result"] for event in done.events if event["event"] == "finished"}
    assert "done" not in results.values()
    lab.fleet.mend("b02")
    lab.node("b02").plug(False)
    until(lambda: cells(lab) == before, "every node to be in the old cell again")
    lab.edit("channel: 1\n", "channel: 11\n")
    lab.edit("confirm_window_s: 61", "confirm_window_s: 600")
    lab.settle()
    until(lambda: lab.meshctl("provision", "--check", expect=None).status == 0, "every node to be as it was")


def test_the_running_mesh_is_changed_from_its_far_end(lab: Lab) -> None:
    lab.edit("reconnect_s: 2.5", "reconnect_s: 5")
    far_first = sorted(("b01", "b02", "husky-front"), key=lambda name: -lab.hops()[name])
    assert far_first == ["husky-front", "b02", "b01"]
    first, *_ = lab.provision(*far_first[::-1])
    begun = [event["node"] for event in first if event["event"] == "started"]
    assert begun == far_first[: len(begun)]
    intervals = {lab.on(name, "batctl meshif bat0 orig_interval").strip() for name in far_first}
    assert intervals == {lab.on("b01", "uci get network.bat0.orig_interval").strip()}
    lab.settle()


def test_a_power_cut_inside_the_window_leaves_the_old_configuration(lab: Lab) -> None:
    power = "uci get wireless.radio0.txpower"
    before = lab.on("husky-rear", power)
    boot = lab.node("husky-rear").boot_id
    lab.edit("  husky-rear: {role: robot,", "  husky-rear: {role: robot, radios: {radio0: {tx_power_dbm: 20}},")
    lab.fleet.break_("husky-rear", "power-cut@reload_config")
    lab.meshctl("provision", "--yes", "husky-rear", expect=1)
    until(lambda: lab.node("husky-rear").is_up() and lab.node("husky-rear").boot_id != boot, "the node to boot")
    until(lambda: lab.on("husky-rear", power) == before, "its old configuration")
    until(lambda: lab.neighbours("husky-rear") == {"b02", "husky-front"}, "its radio to be in the mesh again")
