"""Recreated radios of the virtual fleet: interface indexes, addresses, station tables, and half deafness."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest

from meshctl.model import Release
from meshlab.fleet import VirtualFleet, VirtualNode
from tests.meshlab.conftest import MESH, answers, in_mesh
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]


def index(node: VirtualNode) -> str:
    return node.exec("cat /sys/class/net/mesh0/ifindex").stdout.strip()


def mac(node: VirtualNode) -> str:
    return node.exec("cat /sys/class/net/mesh0/address").stdout.strip()


def station(node: VirtualNode, of: str, what: str) -> int | None:
    found = re.search(rf"{what}:\s*(\d+)", node.exec(f"iw dev mesh0 station get {of}").stdout)
    return None if found is None else int(found[1])


def change(node: VirtualNode, option: str) -> None:
    """Change the radio, and wait until it is set up."""
    node.exec(f"uci set wireless.{option}; uci commit; ubus call network reload").check("change")
    settled(node, option.partition(".")[2])


def settled(node: VirtualNode, option: str) -> None:
    """Wait until netifd has set the radio up with this option."""
    up = f"grep -q '{option}' /tmp/run/netifd/radios && [ ! -L /tmp/run/lock.netifd ]"
    until(lambda: node.exec(up).exit_status == 0, "netifd")


@pytest.fixture
def configured(fleet: VirtualFleet, request: pytest.FixtureRequest) -> Iterator[VirtualNode]:
    """A node with a radio in a cell; nothing of it was synced, so a power cut undoes it."""
    node = fleet.node(request.param)
    node.exec(MESH.format(address="10.42.9.9", channel=6)).check("configure")
    until(lambda: node.exec("iw dev mesh0 link").stdout.startswith("Joined"), "the cell")
    settled(node, "ssid=a team")
    yield node
    node.power_cut()


@pytest.mark.parametrize("configured", ["old", "box", "new"], indirect=True)
def test_interface_recreation_and_its_mac_depend_on_the_release(configured: VirtualNode) -> None:
    release = configured.spec.release
    first, own = index(configured), mac(configured)
    change(configured, "radio0.txpower=11")
    assert (index(configured) == first) == (release > Release.V22_03)
    assert mac(configured) == own
    before = index(configured)
    change(configured, "radio0.channel=11")
    assert index(configured) != before
    assert (mac(configured) == own) == (release <= Release.V22_03)
    change(configured, "mesh0.ssid=other")
    assert mac(configured) == own
    change(configured, f"mesh0.macaddr={own}")
    change(configured, "radio0.channel=6")
    assert mac(configured) == own


def test_a_radio_being_set_up_is_pending_and_has_no_interface(mesh: VirtualFleet) -> None:
    near = mesh.node("near")
    near.exec("uci set wireless.radio0.channel=11; uci commit; reload_config").check("change")
    assert near.exec("iw dev mesh0 info").exit_status == 0
    pending = "ubus call network.wireless status | grep -q '\"pending\": true' && ! [ -e /sys/class/net/mesh0 ]"
    until(lambda: near.exec(pending).exit_status == 0, "netifd")
    until(lambda: "channel 11" in near.exec("iw dev mesh0 info").stdout, "the radio")


@pytest.mark.parametrize("configured", ["box"], indirect=True)
def test_netifd_calls_are_handled_in_order(configured: VirtualNode) -> None:
    configured.exec("for turn in 1 2 3 4 5 6; do wifi down; wifi up; done").check("restart the radio")
    last = "! grep -qE 'lab/netifd|wifi|ubus' /proc/$(cat /tmp/run/netifd.call)/cmdline"
    until(lambda: configured.exec(last).exit_status == 0, "the last call")
    until(lambda: index(configured) != "", "the radio, which the last call set up")


def test_a_restarted_radio_is_half_deaf_until_its_neighbors_delete_its_entry(mesh: VirtualFleet) -> None:
    base, near, far = (mesh.node(name) for name in ("base", "near", "far"))
    macs = mac(base), mac(near), mac(far)
    assert near.exec(f"batctl ping -c 1 {macs[0]}").exit_status == 0
    assert base.exec(f"batctl meshif bat0 ping -c 1 -t 1 {macs[2]}").exit_status == 0
    before = index(near)
    near.exec("wifi down; wifi up").check("restart the radio")
    until(lambda: index(near) not in ("", before) and in_mesh(mesh) == {"near", "far"}, "the radio")
    assert mac(near) == macs[1]
    until(lambda: station(near, macs[0], "connected time") is not None, "the station")
    assert macs[1] in base.exec("batctl meshif bat0 neighbors_json").stdout
    silent = near.exec(f"batctl ping -c 2 -t 1 {macs[0]}")
    assert silent.exit_status == 2
    assert f"Reply from host {macs[0]} timed out" in silent.stdout
    assert not answers(mesh.endpoint("10.42.0.2"))
    for holder in (base, far):
        age_s = station(holder, macs[1], "connected time")
        assert age_s is not None
        assert age_s >= (station(near, mac(holder), "connected time") or 0)
        holder.exec(f"iw dev mesh0 station del {macs[1]}").check("forget")
        assert (station(holder, macs[1], "connected time") or 0) <= age_s
    until(lambda: answers(mesh.endpoint("10.42.0.3")), "the way")
    # the node's tables are written together with reachability, not before
    until(lambda: near.exec(f"batctl -m bat0 ping -c 1 {macs[0]}").exit_status == 0, "the echo")


def test_deleting_the_entry_of_a_running_radio_cuts_it_off_until_it_deletes_its_own(mesh: VirtualFleet) -> None:
    base, near = mesh.node("base"), mesh.node("near")
    base.exec(f"iw dev mesh0 station del {mac(near)}").check("forget")
    until(lambda: not answers(mesh.endpoint("10.42.0.2")), "the cut")
    until(lambda: base.exec(f"batctl ping -c 1 {mac(near)}").exit_status == 2, "its silence")
    near.exec(f"iw dev mesh0 station del {mac(base)}").check("forget")
    until(lambda: answers(mesh.endpoint("10.42.0.2")), "the way")


def test_a_silent_station_entry_remains_with_its_inactive_time(mesh: VirtualFleet) -> None:
    near, far = mesh.node("near"), mesh.node("far")
    of = mac(far)
    far.power_cut(back=False)
    until(lambda: (station(near, of, "inactive time") or 0) >= 2000, "its silence")
    near.exec(f"iw dev mesh0 station del {of}").check("forget")
    assert near.exec(f"iw dev mesh0 station get {of}").exit_status == 254
    unknown = near.exec("batctl ping -c 1 02:99:99:99:99:99")
    assert unknown.exit_status == 2
    assert "Destination Host Unreachable" in unknown.stdout
    far.power_on()
