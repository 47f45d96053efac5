"""Two robots with a roscore, a daemon and a bridge each: what holds between their graphs. Needs scripts/setup-ros."""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.udp_mesh.bridges.ros_processes import BridgeProcess, Master, Robot
from tests.udp_mesh.daemon.processes import RunningDaemon, configuration, poll, wait_online
from tests.udp_mesh.links.sockets import free_port

pytestmark = [pytest.mark.proof, pytest.mark.xdist_group("ros1")]


@dataclass
class Side:
    """One robot."""

    daemon: RunningDaemon
    master: Master
    bridge: BridgeProcess
    robot: Robot


@pytest.fixture(scope="module")
def team() -> Iterator[tuple[Side, Side]]:
    with tempfile.TemporaryDirectory(prefix="udp-mesh-") as path:
        folder, port = Path(path), free_port()
        masters = {name: Master(folder, name) for name in ("alice", "bob")}
        robots: list[Robot] = []
        bridges: list[BridgeProcess] = []
        alice = RunningDaemon(folder, "alice", configuration(folder, "alice", 1, [2], port))
        bob = RunningDaemon(folder, "bob", configuration(folder, "bob", 2, [1], port))
        try:
            with alice, bob:
                sides = []
                for daemon in (alice, bob):
                    master = masters[daemon.name]
                    master.start()
                    bridge = BridgeProcess(folder, master, daemon)
                    bridges.append(bridge)
                    if daemon is alice:
                        listed = "topic_list:=[2|std_msgs/String|listed]"
                        bridge.start(launch=True, arguments=[listed])
                    else:
                        bridge.start()
                    robots.append(Robot(master, f"{daemon.name}_node"))
                    sides.append(Side(daemon, master, bridge, robots[-1]))
                wait_online(alice, "bob")
                wait_online(bob, "alice")
                yield sides[0], sides[1]
                for robot in robots:
                    robot.close()
                for bridge in bridges:
                    bridge.stop()
        finally:
            for bridge in bridges:
                bridge.stop()
            for master in masters.values():
                master.stop()


def test_a_message_to_one_robot_comes_out_typed_under_the_fielded_name(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.robot.subscribe("/alice/mesh_comm/bob/status")
    heard = alice.robot.publish_until_heard("/alice/mesh_comm/bob/status", "ready", bob.robot)
    assert heard["type"] == "std_msgs/String"
    assert heard["definition"].strip() == "string data"


def test_a_message_to_all_comes_out_per_receiver(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.robot.subscribe("/bob/mesh_comm/alice/map")
    bob.robot.publish_until_heard("/bob/mesh_comm/map", "a map", alice.robot)


def test_a_type_installed_nowhere_crosses_with_checksum_and_definition(team: tuple[Side, Side]) -> None:
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


def test_the_first_message_of_a_topic_reaches_who_subscribed_before(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.robot.subscribe("/alice/mesh_comm/bob/listed")
    # Latched at the source, so that only the receiving side can lose it.
    alice.robot.publish("/alice/mesh_comm/bob/listed", "first", latch=True)
    bob.robot.expect("data", "first")


def test_a_latched_message_waits_for_late_subscribers_and_for_a_bridge_that_starts_again(
    team: tuple[Side, Side],
) -> None:
    alice, bob = team
    alice.robot.publish("/alice/mesh_comm/map", "latched map", latch=True)
    late = Robot(bob.master, "late")
    late.subscribe("/alice/mesh_comm/bob/map")
    assert late.expect("data", "latched map")["latching"] == "1"
    bob.bridge.stop()
    bob.bridge.start()
    later = Robot(bob.master, "later")
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


def test_a_topic_added_while_everything_runs_is_carried(team: tuple[Side, Side]) -> None:
    alice, bob = team
    for side in team:
        with side.daemon.client() as client:
            client.request("set-topic", topic="new/topic", values={"priority": 3})
    bob.robot.subscribe("/alice/mesh_comm/bob/new/topic")
    alice.robot.publish_until_heard("/alice/mesh_comm/bob/new/topic", "late news", bob.robot)


def test_the_networks_conditions_are_a_topic(team: tuple[Side, Side]) -> None:
    alice, _ = team
    alice.robot.subscribe("/alice/mesh_status")
    alice.robot.subscribe("/alice/hosts")
    alice.robot.subscribe("/alice/mesh_conditions")

    def told(name: str) -> dict[str, object] | None:
        lines = [line for line in alice.robot.received() if line["name"] == name]
        return dict(json.loads(lines[-1]["data"])) if lines else None

    status = poll(lambda: told("/alice/mesh_status"), "mesh_status")
    assert [(peer["host"], peer["offline"]) for peer in status["peers"]] == [("bob", False)]  # type: ignore[attr-defined]
    hosts = poll(lambda: told("/alice/hosts"), "hosts")
    assert [host["host"] for host in hosts["hosts"]] == ["bob"]  # type: ignore[attr-defined]
    assert "counters" in poll(lambda: told("/alice/mesh_conditions"), "mesh_conditions")


def test_rostopic_knows_what_came(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.robot.publish_until_heard("/alice/mesh_comm/bob/status", "for rostopic", bob.robot)
    command = ["/usr/bin/rostopic", "type", "/alice/mesh_comm/bob/status"]
    shown = subprocess.run(command, env=bob.master.environment, capture_output=True, text=True, check=True)
    assert shown.stdout.strip() == "std_msgs/String"


def test_both_directions_survive_a_restart_of_a_master(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.master.stop()
    bob.master.start()
    fresh = Robot(bob.master, "fresh")
    fresh.subscribe("/alice/mesh_comm/bob/status")
    alice.robot.publish_until_heard("/alice/mesh_comm/bob/status", "after the restart", fresh)
    alice.robot.subscribe("/bob/mesh_comm/alice/status")
    fresh.publish_until_heard("/bob/mesh_comm/alice/status", "and back", alice.robot)
    # Who was connected before the restart still is.
    alice.robot.publish_until_heard("/alice/mesh_comm/bob/status", "to the old node", bob.robot)
    fresh.close()


def test_a_restart_of_the_daemon_is_survived(team: tuple[Side, Side]) -> None:
    alice, bob = team
    alice.daemon.kill()
    alice.daemon.start()
    wait_online(alice.daemon, "bob")
    alice.robot.publish_until_heard("/alice/mesh_comm/bob/status", "after the daemon's restart", bob.robot)
