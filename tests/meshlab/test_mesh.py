"""A fleet as a mesh: reachability, and the effect of links on connections."""

from __future__ import annotations

import contextlib
import hashlib
import json

import paramiko
import pytest

from meshctl.device.parse.batctl import parse_statistics
from meshctl.device.parse.iw import parse_stations, parse_survey
from meshlab.fleet import VirtualFleet
from tests.meshlab.conftest import MESH, answers, connect, factory_reset, in_mesh, run
from tests.waiting import until

pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab")]


def test_a_node_in_the_mesh_is_reachable_at_its_address_and_lists_its_neighbors(mesh: VirtualFleet) -> None:
    transport = connect(mesh.endpoint("10.42.0.3"))
    neighbors = json.loads(run(transport, "batctl meshif bat0 neighbors_json"))
    originators = json.loads(run(transport, "batctl meshif bat0 originators_json"))
    stations = run(transport, "iw dev mesh0 station dump")
    survey = parse_survey(run(transport, "iw dev mesh0 survey dump"))
    counters = parse_statistics(run(transport, "batctl meshif bat0 statistics"))
    info = json.loads(run(transport, 'ubus call iwinfo info \'{"device":"mesh0"}\''))
    transport.close()
    assert len(neighbors) == 1
    assert set(neighbors[0]) == {"hard_ifindex", "hard_ifname", "last_seen_msecs", "neigh_address"}
    assert [path["best"] for path in originators] == [True, True]
    assert {path["neigh_address"] for path in originators} == {neighbors[0]["neigh_address"]}
    assert sorted(path["tq"] for path in originators) == [165, 200]
    assert stations.startswith(f"Station {neighbors[0]['neigh_address']} (on mesh0)\n\tinactive time:\t")
    # a link of -58 dBm above a noise of -95 dBm carries the highest rate
    (station,) = parse_stations(stations) or ()
    assert (station.signal_dbm, station.tx_mcs, station.chain_signals_dbm) == (-58, "MCS 15", (-60, -62))
    assert survey is not None
    assert (survey.noise_dbm, survey.frequency_mhz) == (-95, 2437)
    assert survey.active_ms is not None
    assert survey.busy_ms == pytest.approx(0.01 * survey.active_ms, abs=1)
    assert counters["mgmt_rx_bytes"] > 0
    assert (info["mode"], info["channel"], info["ssid"]) == ("Ad-Hoc", 6, "a team")


def test_a_channel_change_cuts_off_a_node_and_the_nodes_behind_it(mesh: VirtualFleet) -> None:
    mesh.node("near").exec("uci set wireless.radio0.channel=11; uci commit; reload_config").check("change")
    until(lambda: in_mesh(mesh) == set(), "the cut")
    assert not answers(mesh.endpoint("10.42.0.3"))
    until(lambda: mesh.node("far").exec("batctl meshif bat0 neighbors_json").stdout == "[]\n", "empty tables")
    mesh.node("near").exec("uci set wireless.radio0.channel=6; uci commit; reload_config").check("change back")
    until(lambda: answers(mesh.endpoint("10.42.0.3")), "the path to return")


def test_a_node_without_batman_has_no_mesh(mesh: VirtualFleet) -> None:
    near = mesh.node("near")
    near.exec("opkg remove kmod-batman-adv; wifi").check("remove")
    until(lambda: in_mesh(mesh) == set(), "the cut")
    dump = json.loads(near.exec("ubus call network.interface dump").stdout)["interface"]
    bat0 = next(one for one in dump if one["interface"] == "bat0")
    assert bat0["up"] is False
    assert bat0["errors"][0]["code"] == "INVALID_PROTO"


def test_a_down_link_stalls_a_connection_without_closing_it(mesh: VirtualFleet) -> None:
    transport = connect(mesh.endpoint("10.42.0.3"))
    channel = transport.open_session(timeout=60)
    channel.exec_command("cat")
    channel.sendall(b"before\n")
    channel.settimeout(60)
    assert channel.recv(100) == b"before\n"
    mesh.link("near", "far", up=False)
    channel.sendall(b"during\n")
    channel.settimeout(0.5)
    with pytest.raises(TimeoutError):
        channel.recv(100)
    assert transport.is_active()
    assert not answers(mesh.endpoint("10.42.0.3"))
    mesh.link("near", "far", up=True)
    channel.settimeout(60)
    assert channel.recv(100) == b"during\n"
    transport.close()


def test_a_power_cycled_node_is_silent_and_then_resets_the_connection(mesh: VirtualFleet) -> None:
    far = mesh.node("far")
    transport = connect(mesh.endpoint("10.42.0.3"))
    far.power_cut(back=False)
    transport.send_ignore()
    assert transport.is_active()
    far.power_on()
    until(lambda: in_mesh(mesh) == {"near", "far"}, "the mesh of three")

    def ended() -> bool:
        with contextlib.suppress(EOFError, OSError, paramiko.SSHException):
            transport.send_ignore()
        return not transport.is_active()

    until(ended, "the reset")
    transport.close()


def test_a_slow_lossy_link_still_delivers_all_data(mesh: VirtualFleet) -> None:
    mesh.link("base", "near", delay_ms=30, loss=0.02, rate_kbps=4000)
    transport = connect(mesh.endpoint("10.42.0.3"))
    sent = b"x" * 100_000
    channel = transport.open_session(timeout=60)
    channel.settimeout(60)
    channel.exec_command("md5sum")
    channel.sendall(sent)
    channel.shutdown_write()
    with channel.makefile("rb") as output:
        assert output.read().split()[0] == hashlib.md5(sent).hexdigest().encode()
    transport.close()


def test_a_node_severed_at_a_step_keeps_running_in_isolation(mesh: VirtualFleet) -> None:
    far = mesh.node("far")
    mesh.inject_fault("far", "sever@sync")
    far.exec("touch /etc/a; sync; touch /etc/b").check("work")
    until(lambda: in_mesh(mesh) == {"near"}, "the cut")
    assert far.exec("ls /etc/a /etc/b").exit_status == 0
    mesh.repair("far")
    until(lambda: in_mesh(mesh) == {"near", "far"}, "the link to come back")
    until(lambda: answers(mesh.endpoint("10.42.0.3")), "the path to return")


@pytest.mark.parametrize("where", ["far", ""], ids=["the node", "everything"])
def test_a_repair_restores_the_cable_as_it_was_before_the_fault(mesh: VirtualFleet, where: str) -> None:
    def plugged() -> dict[str, bool]:
        return {node["name"]: node["plugged"] for node in mesh.status()["nodes"]}

    mesh.node("near").plug(True)
    before = plugged()
    assert (before["near"], before["far"]) == (True, False)
    for name in ("near", "far"):
        mesh.inject_fault(name, "link-down")
    assert not any(plugged()[name] for name in ("near", "far"))
    for name in ("near", where) if where else ("",):
        mesh.repair(name)
    assert plugged() == before


def test_nodes_with_different_keys_do_not_mesh(mesh: VirtualFleet) -> None:
    for name, key in (("base", "first-secret"), ("near", "first-secret"), ("far", "other-secret")):
        command = (
            f"uci set wireless.mesh0.encryption=psk2+ccmp; uci set wireless.mesh0.key={key}; uci commit; reload_config"
        )
        mesh.node(name).exec(command).check("encrypt")
    until(lambda: in_mesh(mesh) == {"near"}, "the two with the same key")


def test_a_second_set_up_deletes_the_supplicants_socket_but_not_the_supplicant(mesh: VirtualFleet) -> None:
    near = mesh.node("near")
    near.exec("uci set wireless.mesh0.encryption=psk2+ccmp; uci set wireless.mesh0.key=first-secret; uci commit; wifi")
    sockets = "ls /var/run/wpa_supplicant; ubus list 'wpa_supplicant.*'"
    until(lambda: near.exec(sockets).stdout == "mesh0\nwpa_supplicant.mesh0\n", "the supplicant")
    near.exec("uci set wireless.radio0.txpower=17; uci commit; reload_config").check("change the power")
    until(lambda: near.exec(sockets).stdout == "wpa_supplicant.mesh0\n", "the second set-up")


def test_the_same_release_encrypts_only_with_a_full_supplicant(mesh: VirtualFleet) -> None:
    near = mesh.node("near")
    near.exec("opkg remove wpad-openssl").check("remove")
    near.exec("uci set wireless.mesh0.encryption=psk2+ccmp; uci set wireless.mesh0.key=secret-123; uci commit; wifi")
    until(lambda: near.exec("iw dev mesh0 link").stdout == "Not connected.\n", "the radio")


def test_openwrt_25_12_joins_an_open_cell_when_configured_for_encryption(fleet: VirtualFleet) -> None:
    new = fleet.node("new")
    new.exec(MESH.format(address="10.42.9.9", channel=6)).check("configure")
    new.exec("uci set wireless.mesh0.encryption=psk2+ccmp; uci set wireless.mesh0.key=secret-123; uci commit; wifi")
    asked = "grep -q 'key=secret-123' /tmp/run/netifd/radios && iw dev mesh0 link"
    until(lambda: new.exec(asked).stdout.startswith("Joined IBSS"), "the cell")
    info = json.loads(new.exec('ubus call iwinfo info \'{"device":"mesh0"}\'').stdout)
    assert info["encryption"]["enabled"] is False
    factory_reset(new)
