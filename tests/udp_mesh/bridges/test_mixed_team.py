"""A robot with a real ROS 1 and one with a real ROS 2 on one mesh: typed programs read what the other's publish."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from benchmarks.link.laboratory import Link, laboratory
from tests.udp_mesh.bridges.bridge_processes import NodeProcess
from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.bridges.ros2_processes import Ros2Bridge, Ros2Node, hear_only_loopback
from tests.udp_mesh.bridges.ros_team import RobotsDaemon
from tests.udp_mesh.daemon.processes import RATES, poll, wait_online
from udp_mesh.bridges.message_codec import encode, numbers
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ros2_type

pytestmark = pytest.mark.xdist_group("ros2")

LINK = Link(rate=20e6, delay_ms=5.0, loss=0.05)
DOMAIN = 73
TOPICS = """
[topics]
status = { priority = 0 }
odometry = { priority = 3 }
cloud = { priority = 8 }
image = { priority = 9 }
map = { priority = 5 }
"""
HEADER = {"frame_id": "odom", "stamp": (7, 9)}
POINT = {"name": "x", "offset": 0, "datatype": 7, "count": 1}
CLOUD = {
    "header": HEADER,
    "height": 1,
    "width": 500,
    "point_step": 4,
    "row_step": 2000,
    "is_dense": True,
    "fields": [POINT],
    "data": numbers("uint8", [number % 251 for number in range(2000)]),
}
MESSAGES: dict[str, tuple[str, dict[str, Any]]] = {
    "status": ("std_msgs/String", {"data": "ready"}),
    "odometry": (
        "nav_msgs/Odometry",
        {
            "header": HEADER,
            "child_frame_id": "base_link",
            "pose": {"pose": {"position": {"x": 1.5}, "orientation": {"w": 1.0}}},
            "twist": {"twist": {"angular": {"z": -0.25}}},
        },
    ),
    "cloud": ("sensor_msgs/PointCloud2", CLOUD),
    "image": (
        "sensor_msgs/CompressedImage",
        {"header": HEADER, "format": "jpeg", "data": numbers("uint8", [255, 216])},
    ),
}
"""By topic: a message that both publish."""
ROS1_SHOWS = {
    "status": ["ready"],
    "odometry": ["secs: 7", "nsecs:", 'frame_id: "odom"', 'child_frame_id: "base_link"', "x: 1.5", "z: -0.25"],
    "cloud": ["width: 500", 'name: "x"', "datatype: 7", f"data: {[number % 251 for number in range(2000)]}"],
    "image": ['format: "jpeg"', "data: [255, 216]"],
}
"""What rospy's own classes print of them."""
ROS2_SHOWS = {
    "status": ["data='ready'"],
    "odometry": ["sec=7", "nanosec=9", "frame_id='odom'", "child_frame_id='base_link'", "x=1.5", "z=-0.25"],
    "cloud": ["width=500", "name='x'", "datatype=7", str([number % 251 for number in range(2000)])[1:-1]],
    "image": ["format='jpeg'", "[255, 216]"],
}
"""How rclpy's classes show themselves."""


@dataclass
class Team:
    old: Ros1Node
    """A program of alice, which has ROS 1."""
    new: Ros2Node
    """A program of bob, which has ROS 2."""


@pytest.fixture(scope="module")
def team() -> Iterator[Team]:
    # A Unix socket's path has at most 107 bytes: pytest's folders are too long.
    with (
        tempfile.TemporaryDirectory(prefix="udp-mesh-") as path,
        laboratory(2, link=LINK) as lab,
        ExitStack() as kept,
    ):
        inside = [lab.inside(place, []) for place in range(2)]
        master = Master(Path(path), "alice", inside[0])
        kept.callback(master.stop)
        master.start(wait=False)
        hear_only_loopback(lab, 1)
        alice = kept.enter_context(RobotsDaemon(Path(path), "alice", inside[0], TOPICS, RATES))
        bob = kept.enter_context(RobotsDaemon(Path(path), "bob", inside[1], TOPICS, RATES))
        master.wait()
        for bridge in (Ros1Bridge(master, alice), Ros2Bridge(bob, DOMAIN, inside[1])):
            kept.callback(bridge.stop)
            bridge.start()
        made = Team(Ros1Node(master, "alice_node"), Ros2Node(bob.folder, "bob_node", DOMAIN, inside[1]))
        kept.callback(made.old.close)
        kept.callback(made.new.close)
        wait_online(alice, "bob")
        wait_online(bob, "alice")
        yield made


@pytest.mark.parametrize("topic", MESSAGES)
def test_a_ros_2_robot_reads_what_a_ros_1_robot_publishes(team: Team, topic: str) -> None:
    type_name, values = MESSAGES[topic]
    name = f"/alice/mesh_comm/bob/{topic}"
    team.new.subscribe(name, type=ros2_type(type_name), parsed=True)
    shown = until_read(team.old, team.new, name, encode(TYPES[type_name], values, 1), type_name)
    assert [part for part in ROS2_SHOWS[topic] if part not in shown] == [], shown


@pytest.mark.parametrize("topic", MESSAGES)
def test_a_ros_1_robot_reads_what_a_ros_2_robot_publishes(team: Team, topic: str) -> None:
    type_name, values = MESSAGES[topic]
    name = f"/bob/mesh_comm/alice/{topic}"
    team.old.subscribe(name, type_name)
    shown = until_read(team.new, team.old, name, encode(TYPES[type_name], values, 2), type_name)
    assert [part for part in ROS1_SHOWS[topic] if part not in shown] == [], shown


def test_a_latched_message_reaches_a_late_subscriber_of_the_other_version(team: Team) -> None:
    team.old.publish("/alice/mesh_comm/bob/map", "of ROS 1", latch=True)
    team.new.publish("/bob/mesh_comm/alice/map", "of ROS 2", latched=True)
    team.new.subscribe("/alice/mesh_comm/bob/map", latched=True)
    assert team.new.expect("data", "of ROS 1")["name"] == "/alice/mesh_comm/bob/map"
    team.old.subscribe("/bob/mesh_comm/alice/map")
    assert team.old.expect("data", "of ROS 2")["latching"] == "1"


def until_read(source: NodeProcess, reader: NodeProcess, name: str, payload: bytes, type_name: str) -> str:
    """Publishes until the other robot's program has read it; what that shows."""
    definition = TYPES[type_name]

    def found() -> str | None:
        if isinstance(source, Ros1Node):
            more = {"md5sum": definition.md5sum, "definition": definition.text}
            source.publish(name, payload.hex(), type_name, **more)
        else:
            source.publish(name, {"cdr": payload.hex()}, type=ros2_type(type_name))
        line = next((line for line in reader.received() if line["name"] == name), None)
        return None if line is None else str(line["data"])

    return poll(found, f"a message on {name}")
