"""Changing a mesh of real radios over that mesh itself: order, switch, undo, cuts."""

from __future__ import annotations

import io
import re
import tarfile
from pathlib import Path

import pytest

from tests.meshctl.lab_real.conftest import NODES, Lab, until

pytestmark = [pytest.mark.proof, pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

# by how much two nodes may differ in when they heard of each other; far below the time since the mesh was made
SLACK_S = 20


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


def test_a_radio_that_starts_anew_is_heard_again_by_those_before_it_and_those_behind_it(lab: Lab) -> None:
    lab.edit("  b[01-02]: {role: beacon,", "  b[01-02]: {role: beacon, radios: {radio0: {tx_power_dbm: 20}},")
    # who has not spoken for minutes may be known to nobody, and then is not asked
    until(lambda: "1 packets received" in lab.on("b01", "ping -c 1 -W 5 10.42.0.2 || true"), "b01 to be known")
    last = lab.provision("b02")[-1]
    steps = [event["text"] for event in last if event["event"] == "step"]
    assert steps.index("neighbours watch it") < steps.index("apply")
    # without a word from anybody else: unicast from the node to each of its neighbours is taken
    addresses = ("10.42.0.101", "10.42.0.11", "10.42.0.12")
    until(
        lambda: all("1 packets received" in lab.on("b02", f"ping -c 1 -W 5 {one} || true") for one in addresses),
        "answers from every neighbour",
    )
    until(lambda: not _known_longer_than_itself(lab, "b02"), "every neighbour to have forgotten the radio that it had")
    lab.settle()


def _known_longer_than_itself(lab: Lab, name: str) -> list[str]:
    """The neighbours that know the node's radio for longer than it has known anybody."""
    mac = next(mac for mac, node in lab.names().items() if node == name)
    command = "iw dev mesh0 station {what} | sed -n 's/.*connected time:[^0-9]*\\([0-9]*\\).*/\\1/p'"
    own = max(int(age) for age in lab.on(name, command.format(what="dump")).split())
    ages = {other: lab.on(other, command.format(what=f"get {mac}")).split() for other in lab.neighbours(name)}
    return [other for other, age in ages.items() if not age or int(age[0]) > own + SLACK_S]


def test_a_configuration_that_cuts_a_node_off_is_taken_back_by_the_node_itself(lab: Lab, tmp_path: Path) -> None:
    before = cells(lab)
    lab.meshctl("backup", "b02", "--out", str(tmp_path))
    (kept,) = tmp_path.glob("b02-*.tgz")
    bad = tmp_path / "bad.tgz"
    bad.write_bytes(with_other_channel(kept.read_bytes(), 1))
    lab.edit("confirm_window_s: 600", "confirm_window_s: 61")
    done = lab.meshctl("restore", "b02", str(bad), "--yes", expect=1)
    lab.edit("confirm_window_s: 61", "confirm_window_s: 600")
    # on a starved host it may not be seen again in time; it is back all the same
    assert "rolled back" in done.text + done.errors or "uncertain" in done.text + done.errors
    until(lambda: cells(lab) == before, "the node to be in its cell again")
    told = lab.on("b02", "meshctl-deadman status")
    assert "last_outcome=restored last_reason=timeout" in told
    lab.settle()


def with_other_channel(archive: bytes, channel: int) -> bytes:
    """A backup in which the radio is on another channel."""
    out = io.BytesIO()
    with (
        tarfile.open(fileobj=io.BytesIO(archive), mode="r:gz") as source,
        tarfile.open(fileobj=out, mode="w:gz", format=tarfile.USTAR_FORMAT) as target,
    ):
        for member in source:
            stream = source.extractfile(member) if member.isreg() else None
            content = stream.read() if stream is not None else b""
            if member.name.endswith("etc/config/wireless"):
                content, count = re.subn(rb"option channel '\d+'", b"option channel '%d'" % channel, content)
                assert count == 1
                member.size = len(content)
            target.addfile(member, io.BytesIO(content) if stream is not None else None)
    return out.getvalue()


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
