"""Two robots with a roscore, a daemon and a bridge each, one bridge started by roslaunch, the other in Python 3.8 where
there is one: what holds between their graphs. Needs scripts/setup-ros."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.udp_mesh.bridges.ros1_processes import OLD_PYTHON, ROOT, Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.daemon.processes import PATIENT_RATES, RunningDaemon, configuration, poll, wait_online
from tests.udp_mesh.links.sockets import free_port

HEADER = "=" * 80 + "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
PEER = "string host\nstring addr\nuint32 xmitDepth\nuint32 seqNum\nuint32 staleInflightCount\nuint32 incompleteCount\n"
FIELDED = {
    "mesh_status": (
        "udp_mesh/NetworkStats",
        "Header header\nPeerStats[] peers\n"
        + (
            "=" * 80 + "\nMSG: udp_mesh/PeerStats\n" + PEER + "duration lastRTT\nbool offline\ntime lastSeen\n" + HEADER
        ),
    ),
    "hosts": ("udp_mesh/HostEntry", "Header header\nstring host\nstring mac\n" + HEADER),
}
"""The legacy package's messages, as its users' programs know them."""

LAUNCH = """
<launch>
  <include file="{place}/launch/rudp_mesh_node.launch">
    <arg name="mesh_data_port" value="8700"/>
    <arg name="mesh_interface" value="wlan0"/>
    <arg name="mesh_hostname" value="alice"/>
    <arg name="mesh_heartbeat_interval" value="1.0"/>
    <arg name="topic_list" value="[2|std_msgs/String|listed,
                                   8|sensor_msgs/Image|image_raw]"/>
    <arg name="use_broadcast" value="true"/>
    <arg name="broadcast_frag_max" value="5"/>
    <arg name="mesh_socket" value="{socket}"/>
  </include>
</launch>
"""
"""A legacy robot's own launch file, every argument given. Its include is the line that changes; the socket's place is
the test's."""

pytestmark = [pytest.mark.proof, pytest.mark.xdist_group("ros1")]


@dataclass
class Side:
    """One robot."""

    daemon: RunningDaemon
    master: Master
    bridge: Ros1Bridge
    robot: Ros1Node


@pytest.fixture(scope="module")
def team() -> Iterator[tuple[Side, Side]]:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path, ExitStack() as kept:
        folder, port = Path(path), free_port()
        sides = []
        masters = {name: Master(folder, name) for name in ("alice", "bob")}
        for master in masters.values():
            kept.callback(master.stop)
            master.start(wait=False)
        for name, own, other in (("alice", 1, 2), ("bob", 2, 1)):
            text = configuration(folder, name, own, [other], port, rates=PATIENT_RATES)
            daemon = RunningDaemon(folder, name, text)
            kept.enter_context(daemon)
            master = masters[name]
            master.wait()
            bridge = Ros1Bridge(master, daemon, python=OLD_PYTHON)
            kept.callback(bridge.stop)
            if name == "alice":
                launch = folder / "robot.launch"
                launch.write_text(LAUNCH.format(place=ROOT / "udp_mesh/bridges/ros1", socket=daemon.socket))
                bridge.start(launch=str(launch))
            else:
                bridge.start()
            robot = Ros1Node(master, f"{name}_node")
            kept.callback(robot.close)
            sides.append(Side(daemon, master, bridge, robot))
        wait_online(sides[0].daemon, "bob")
        wait_online(sides[1].daemon, "alice")
        yield sides[0], sides[1]


def test_a_unicast_message_is_published_with_its_type_under_the_legacy_name(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.robot.subscribe("/alice/mesh_comm/bob/status")
    heard = alice.robot.publish_until_received("/alice/mesh_comm/bob/status", "ready", bob.robot)
    assert heard["type"] == "std_msgs/String"
    assert heard["definition"].strip() == "string data"


def test_a_broadcast_is_published_under_a_per_receiver_name(team: tuple[Side, Side]) -> None:
    alice, bob = team
    name = "/bob/mesh_comm/alice/map"
    alice.robot.subscribe(name)
    bob.robot.publish_until_received("/bob/mesh_comm/map", "a map", alice.robot, received_as=name)


def test_an_uninstalled_type_is_relayed_with_its_md5sum_and_definition(team: tuple[Side, Side]) -> None:
    alice, bob = team
    made = {"type_name": "made_up/Thing", "md5sum": "0123456789abcdef" * 2, "definition": "uint8[] thing\n"}
    bob.robot.subscribe("/alice/mesh_comm/bob/any", "*")
    alice.robot.publish("/alice/mesh_comm/bob/any", "00ff10", **made)

    def came() -> dict[str, object] | None:
        alice.robot.publish("/alice/mesh_comm/bob/any", "00ff10", **made)
        return next((line for line in bob.robot.received() if line.get("hex") == "00ff10"), None)

    heard = poll(came, "the thing")
    assert (heard["type"], heard["md5sum"], heard["definition"]) == (
        "made_up/Thing",
        "0123456789abcdef" * 2,
        "uint8[] thing\n",
    )


def test_a_name_that_nothing_reads_and_a_second_bridge_are_reported(team: tuple[Side, Side]) -> None:
    _, bob = team
    bob.robot.publish("/bob/mesh_comm/maps", "for nobody")
    second = Ros1Bridge(bob.master, bob.daemon, python=OLD_PYTHON)
    second.log = bob.master.folder / "second-bridge.log"
    second.start(arguments=["__name:=second"])
    expected = [
        (bob.bridge, "not-sent name=/bob/mesh_comm/maps "),
        (bob.bridge, "two-bridges node=/second "),
        (second, "two-bridges node=/mesh_bridge "),
    ]
    try:
        poll(lambda: all(text in bridge.log.read_text() for bridge, text in expected) or None, "the reports")
        # what robots read, offer or publish for each other is none of those
        assert bob.bridge.log.read_text().count("not-sent ") == 1
    finally:
        second.stop()


def test_the_first_message_of_a_topic_reaches_an_existing_subscriber(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.robot.subscribe("/alice/mesh_comm/bob/listed")
    # Latched at the source, so that only the receiving side can lose it.
    alice.robot.publish("/alice/mesh_comm/bob/listed", "first", latch=True)
    bob.robot.expect("data", "first")


def test_a_latched_message_reaches_late_subscribers_even_after_a_bridge_restart(
    team: tuple[Side, Side],
) -> None:
    alice, bob = team
    alice.robot.publish("/alice/mesh_comm/map", "latched map", latch=True)
    late = Ros1Node(bob.master, "late")
    late.subscribe("/alice/mesh_comm/bob/map")
    assert late.expect("data", "latched map")["latching"] == "1"
    bob.bridge.stop()
    bob.bridge.start()
    later = Ros1Node(bob.master, "later")
    later.subscribe("/alice/mesh_comm/bob/map")
    later.expect("data", "latched map")
    late.close()
    later.close()


def test_a_topic_may_change_its_type(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.robot.subscribe("/alice/mesh_comm/bob/video", "*")

    def came(type_name: str, data: object) -> dict[str, object]:
        def heard() -> dict[str, object] | None:
            alice.robot.publish("/alice/mesh_comm/bob/video", data, type_name)
            return next((line for line in bob.robot.received() if line["type"] == type_name), None)

        return poll(heard, type_name)

    came("std_msgs/String", "text")
    came("std_msgs/Int32", 7)


def test_a_topic_added_at_runtime_is_relayed(team: tuple[Side, Side]) -> None:
    alice, bob = team
    for side in team:
        with side.daemon.client() as client:
            client.request("set-topic", topic="new/topic", values={"priority": 3})
    bob.robot.subscribe("/alice/mesh_comm/bob/new/topic")
    alice.robot.publish_until_received("/alice/mesh_comm/bob/new/topic", "late news", bob.robot)


def test_the_legacy_status_messages_and_service_need_no_package(team: tuple[Side, Side]) -> None:
    alice, _ = team
    for name, (type_name, definition) in FIELDED.items():
        alice.robot.subscribe(f"/alice/{name}", type_name, definition=definition)
    status = alice.robot.expect("name", "/alice/mesh_status")
    assert status["md5sum"] == "b798b3f36b773e8807958d91f6f464bb"
    poll(lambda: 'host: "bob"' in alice.robot.expect("name", "/alice/mesh_status")["text"], "bob in mesh_status")
    entry = alice.robot.expect("name", "/alice/hosts")
    assert entry["md5sum"] == "b444fcd5e93804f9d8148d66d10b2520"
    assert 'host: "bob"' in entry["text"]
    assert 'mac: "127.0.3.2"' in entry["text"]
    bob_alone = {"hosts": ["bob"], "macs": ["127.0.3.2"]}
    poll(lambda: alice.robot.call("/alice/getHosts") == bob_alone, "bob from the service")


def test_network_conditions_are_published_as_a_topic(team: tuple[Side, Side]) -> None:
    alice, _ = team
    alice.robot.subscribe("/alice/mesh_conditions")
    conditions = json.loads(alice.robot.expect("name", "/alice/mesh_conditions")["data"])
    assert [(peer["name"], peer["online"]) for peer in conditions["peers"]] == [("bob", True)]
    assert "counters" in conditions


def test_the_legacy_settings_message_sets_the_window(team: tuple[Side, Side]) -> None:
    alice, _ = team
    settings = {"type_name": "udp_mesh/MeshSettings", "md5sum": "00" * 16, "definition": "uint8 windowSize\n"}

    def window() -> object:
        with alice.daemon.client() as client:
            return client.request("status")["conditions"]["peers"][0]["window_packets"]

    def narrowed() -> bool:
        alice.robot.publish("/alice/mesh_settings", "03", **settings)
        return window() == 3

    poll(narrowed, "a window of 3")
    alice.robot.publish("/alice/mesh_settings", "00", **settings)
    poll(lambda: window() != 3, "an adaptive window")


def test_rostopic_reports_the_type_of_a_relayed_topic(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.robot.publish_until_received("/alice/mesh_comm/bob/status", "for rostopic", bob.robot)
    command = ["/usr/bin/rostopic", "type", "/alice/mesh_comm/bob/status"]
    shown = subprocess.run(command, env=bob.master.environment, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "std_msgs/String"


def test_both_directions_survive_a_restart_of_a_master(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.master.stop()
    bob.master.start()
    fresh = Ros1Node(bob.master, "fresh")
    fresh.subscribe("/alice/mesh_comm/bob/status")
    alice.robot.publish_until_received("/alice/mesh_comm/bob/status", "after the restart", fresh)
    alice.robot.subscribe("/bob/mesh_comm/alice/status")
    fresh.publish_until_received("/bob/mesh_comm/alice/status", "and back", alice.robot)
    # Who was connected before the restart still is.
    alice.robot.publish_until_received("/alice/mesh_comm/bob/status", "to the old node", bob.robot)
    fresh.close()


def test_a_daemon_restart_is_survived(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.daemon.kill()
    alice.daemon.start()
    wait_online(alice.daemon, "bob")
    alice.robot.publish_until_received("/alice/mesh_comm/bob/status", "after the daemon's restart", bob.robot)
