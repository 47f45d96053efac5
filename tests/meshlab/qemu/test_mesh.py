"""From factory state to a working mesh of the kernel's radios, and changes over that mesh itself."""

from __future__ import annotations

import json
import time
from typing import Any

import pytest

from meshctl.device.link_table import answering_script, is_complete, parse_links
from meshctl.device.parse.sections import split_sections
from meshctl.robots.radio_report import Names, RadioTracker
from meshlab.qemu import control
from tests.meshlab.qemu.conftest import NODES, Lab, until

# the first test includes the machine's start, the download of packages and the provisioning of the fleet
pytestmark = [pytest.mark.lab, pytest.mark.xdist_group("lab-real"), pytest.mark.timeout(1800)]

# numbers sent as broadcasts from the base's computer, and those that arrive at the Husky's, in the order of arrival
_BROADCAST = """
cat >/tmp/listen.py <<'END'
import socket
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.bind(("", 9999))
s.settimeout(4)
try:
    while True:
        print(s.recv(100).decode())
except TimeoutError:
    pass
END
cat >/tmp/shout.py <<'END'
import socket, time
s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
s.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
for n in range(20):
    s.sendto(str(n).encode(), ("10.42.0.255", 9999))
    time.sleep(0.02)
END
ip netns exec pc.husky python3 /tmp/listen.py >/tmp/heard &
until grep -q :270F /proc/$!/net/udp; do sleep 0.1; done
ip netns exec pc.base-station python3 /tmp/shout.py
wait
cat /tmp/heard
"""


def test_the_provisioned_mesh_spans_three_hops_and_connects_lans(lab: Lab) -> None:
    # the kernel's own routes: each hop only hears the next
    assert lab.originators("base") == {"b01": "b01", "b02": "b01", "husky-front": "b01", "husky-rear": "b01"}
    assert lab.originators("b01")["husky-front"] == "b02"
    assert lab.neighbors("b02") == {"b01", "husky-front", "husky-rear"}
    # node to node over three hops, and computer to computer behind them
    until(lambda: "2 packets received" in lab.on("base", "ping -c 2 -W 5 10.42.0.11 || true"), "three hops")
    assert lab.answers("husky", "10.42.0.2")


def test_radios_run_with_the_rendered_configuration(lab: Lab) -> None:
    for name in NODES:
        info = lab.on(name, "iw dev mesh0 info; iw dev mesh0 link; cat /sys/class/net/mesh0/mtu")
        channel = lab.on(name, "uci get wireless.radio0.channel").strip()
        assert f"channel {channel} (" in info
        assert f"ssid {lab.on(name, 'uci get wireless.mesh0.ssid').strip()}" in info
        assert f"Joined IBSS {lab.on(name, 'uci get wireless.mesh0.bssid').strip()} (on mesh0)" in info
        assert info.splitlines()[-1] == lab.on(name, "uci get network.mesh0.mtu").strip()
        mesh = json.loads(lab.on(name, "batctl meshif bat0 mesh_json"))
        assert mesh["orig_interval"] == int(lab.on(name, "uci get network.bat0.orig_interval"))
        assert mesh["algo_name"] == lab.on(name, "uci get network.bat0.routing_algo").strip()
        assert mesh["bridge_loop_avoidance_enabled"] is True


def test_two_radios_on_one_switch_pass_a_broadcast_once_and_make_no_storm(lab: Lab) -> None:
    def arrived_once() -> bool:
        heard = control.run(lab.fleet.directory, _BROADCAST).check("broadcast").stdout
        return heard.split() == [str(number) for number in range(20)]

    # loop avoidance may hold broadcasts for half a minute
    until(arrived_once, "20 broadcasts to come through once each")
    frames = "cat /sys/class/net/eth0/statistics/rx_packets"
    before = int(lab.computer("husky", frames))
    lab.computer("husky", "sleep 5")
    # idle traffic on the switch: the loop avoidance's claims, a few neighbor solicitations
    assert int(lab.computer("husky", frames)) - before < 200


def test_topology_matches_the_kernel_neighbor_tables(lab: Lab) -> None:
    drawn = _topology_of_one_moment(lab)
    cuts_off = {node["name"]: set(node["cuts_off"]) for node in drawn["nodes"]}
    assert cuts_off["b01"] == {"b02", "husky-front", "husky-rear"}
    assert cuts_off["b02"] == {"husky-front", "husky-rear"}
    assert cuts_off["husky-front"] == cuts_off["husky-rear"] == set()


def _topology_of_one_moment(lab: Lab) -> Any:
    """The topology of meshctl. Its links match the kernels' neighbor tables just after, each node's hops their routes
    just before or just after. On a starved host a node may not answer in time.
    """
    drawn: Any = None

    def agrees() -> bool:
        nonlocal drawn
        before = lab.hops()
        done = lab.meshctl("topology", "--json", expect=None)
        if done.status != 0:
            return False
        drawn = done.json
        after = lab.hops()
        shown_hops = {node["name"]: node["hops"] for node in drawn["nodes"]}
        linked: dict[str, set[str]] = {name: set() for name in NODES}
        for link in drawn["links"]:
            linked[link["a"]].add(link["b"])
            linked[link["b"]].add(link["a"])
        return linked == {name: lab.neighbors(name) for name in NODES} and all(
            shown_hops.get(name) in (before[name], after[name]) for name in NODES
        )

    until(agrees, "the drawn links and hops to be those of the kernels")
    return drawn


def test_status_lists_the_stations_heard_by_each_radio(lab: Lab) -> None:
    names = lab.names()

    def agrees() -> bool:
        reported = lab.meshctl("status", "--json", "--timeout", "30", expect=None).json["nodes"]
        nodes = {node["name"]: node for node in reported if node["answers"]}
        return nodes.keys() == set(NODES) and all(
            {neighbor["name"] for neighbor in node["neighbours"]} == heard(name) for name, node in nodes.items()
        )

    def heard(name: str) -> set[str]:
        stations = lab.on(name, "iw dev mesh0 station dump")
        return {names[line.split()[1]] for line in stations.splitlines() if line.startswith("Station")}

    until(agrees, "the reported neighbors to be the stations of the kernels")


def test_status_shows_what_the_kernels_radios_measure(lab: Lab) -> None:
    nodes: list[dict[str, Any]] = []

    def all_answer() -> bool:
        nodes[:] = lab.meshctl("status", "--json", "--timeout", "30", expect=None).json["nodes"]
        return all(node["mesh_statistics"] for node in nodes)

    # on a starved host one of them may not answer in time
    until(all_answer, "an answer of every node")
    for node in nodes:
        assert node["mesh_statistics"]["bat0"]["mgmt_tx"] > 0
        # Linux 6.1's mac80211_hwsim marks no channel of its survey as the one in use: noise and SNR are unknown
        assert {radio["noise_dbm"] for radio in node["radios"]} <= {None, -92}
        for neighbor in node["neighbours"]:
            known = any(radio["noise_dbm"] is not None for radio in node["radios"])
            assert neighbor["snr_db"] == (neighbor["signal_dbm"] + 92 if known else None)
            assert neighbor["tx_bitrate_kbit_s"] > 0


def test_a_robot_reads_its_radio_path_from_the_kernels_tables(lab: Lab) -> None:
    names = Names(lab.names(), {"base-station": ("base",)})
    tracker = RadioTracker(load_mbit_s=2.0)
    nonces = ("meshctl-1", "meshctl-2")

    def found() -> list[dict[str, Any]]:
        """As the collector asks: twice over one shell, here that of the node's console."""
        for name in ("husky-front", "husky-rear"):
            output = lab.node(name).exec(answering_script(), stdin="".join(f"{nonce}\n" for nonce in nonces).encode())
            assert is_complete(output.stdout_bytes, nonces[1])
            table = parse_links(split_sections(output.stdout_bytes, nonces[1]), (), taken_s=time.monotonic())
            assert table.paths is not None
            tracker.take(name, table)
        paths: list[dict[str, Any]] = tracker.report(names, "husky", "", time.monotonic())["paths"]
        return paths

    until(lambda: [path["next_hop"] for path in found()] == ["b02"], "the path to the base through b02")
    (path,) = found()
    assert path["peer"] == "base-station"
    assert path["quality"] > 0.5
    assert path["signal_dbm"] < 0
    assert path["bottleneck_bits_per_s"] > 0


def test_the_machines_clock_runs_as_fast_as_the_hosts(lab: Lab) -> None:
    def uptime_s() -> tuple[float, float, float]:
        """The machine's, and the host's clock before and after."""
        before_s = time.monotonic()
        text = control.run(lab.fleet.directory, "cat /proc/uptime").check("read the uptime").stdout
        return before_s, float(text.split()[0]), time.monotonic()

    earliest_s, started_s, begun_s = uptime_s()
    time.sleep(2.0)
    ending_s, ended_s, latest_s = uptime_s()
    assert 0.95 * (ending_s - begun_s) < ended_s - started_s < 1.05 * (latest_s - earliest_s)


def test_a_link_has_the_configured_loss_and_goes_down_at_once(lab: Lab) -> None:
    def quality() -> int:
        known = json.loads(lab.on("b01", "batctl meshif bat0 originators_json"))
        names = lab.names()
        return next((one["tq"] for one in known if one.get("best") and names[one["orig_address"]] == "base"), 0)

    until(lambda: quality() > 230, "the link's full quality")
    lab.meshctl("lab", "link", "base", "b01", "--loss", "0.4")
    until(lambda: quality() < 190, "losses to show in batman-adv's quality")
    lab.meshctl("lab", "link", "base", "b01", "--down")
    until(lambda: "base" not in lab.neighbors("b01"), "the link to be gone")
    lab.meshctl("lab", "mend", "base-b01")
    lab.settle()
    until(lambda: quality() > 230, "the link's full quality again")


def test_two_radios_on_a_switch_agree_which_of_them_forwards_broadcasts(lab: Lab) -> None:
    """On an idle machine, radios that hear a frame in the same moment never do (docs/lab.md)."""
    mac = lab.computer("base-station", "cat /sys/class/net/eth0/address").strip()

    def owner(name: str) -> str:
        claims = map(str.split, lab.on(name, "batctl meshif bat0 claimtable -H").splitlines())
        return next((by for client, _, _, _, by, *_ in claims if client == mac), "")

    def is_agreed() -> bool:
        lab.answers("base-station", lab.FAR_COMPUTER)
        return owner("husky-front") == owner("husky-rear") != ""

    until(is_agreed, "the radios to agree")
