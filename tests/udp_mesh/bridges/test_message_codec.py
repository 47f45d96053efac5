"""Messages between ROS 1 and ROS 2, against the serializers of both where they are installed."""

from __future__ import annotations

import json
import subprocess
from typing import Any

import pytest

from tests.udp_mesh.bridges.interpreters import ROS_PYTHON, expects_ros
from tests.udp_mesh.bridges.ros2_processes import PYTHON, environment, expects_ros2
from udp_mesh.bridges.configuration import BridgeConfigurationError, parse_configuration
from udp_mesh.bridges.message_codec import CodecError, converted, decode, encode, numbers
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.relay import Note, Relay, ToRos
from udp_mesh.bridges.types import TypeKey

ROS1 = """
import io, json, roslib.message, rospy
found = {}
for name in %s:
    made = roslib.message.get_message_class(name)
    message = made()
    if hasattr(message, "header"):
        message.header.seq, message.header.frame_id, message.header.stamp = 0, "odom", rospy.Time(7, 9)
    fill(message, name)
    data = io.BytesIO()
    message.serialize(data)
    found[name] = [made._md5sum, data.getvalue().hex()]
print(json.dumps(found))
"""
ROS2 = """
import importlib, json
from rclpy.serialization import serialize_message
found = {}
for name in %s:
    package, kind = name.split("/")
    message = getattr(importlib.import_module(package + ".msg"), kind)()
    if hasattr(message, "header"):
        message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec = "odom", 7, 9
    fill(message, name)
    found[name] = bytes(serialize_message(message)).hex()
print(json.dumps(found))
"""
FILL = """
def fill(message, name):
    if name == "std_msgs/String":
        message.data = "ready"
    elif name == "nav_msgs/Odometry":
        message.child_frame_id, message.pose.pose.position.x = "base_link", 1.5
        message.pose.pose.orientation.w = 1.0
        message.twist.twist.angular.z, message.pose.covariance = -0.25, [float(each) for each in range(36)]
    elif name == "sensor_msgs/PointCloud2":
        import importlib
        field = importlib.import_module("sensor_msgs.msg").PointField(name="x", offset=0, datatype=7, count=1)
        message.height, message.width, message.fields, message.point_step, message.row_step = 1, 2, [field], 4, 8
        message.data, message.is_dense = bytes(range(8)), True
    elif name == "sensor_msgs/CompressedImage":
        message.format, message.data = "jpeg", b"\\xff\\xd8123"
"""
NAMES = ["std_msgs/String", "nav_msgs/Odometry", "sensor_msgs/PointCloud2", "sensor_msgs/CompressedImage"]


@pytest.mark.skipif(not (expects_ros() and expects_ros2()), reason="needs scripts/setup-ros and scripts/setup-ros2")
def test_both_serializers_agree_with_the_conversion() -> None:
    first = _run([ROS_PYTHON], FILL + ROS1 % NAMES, {"PATH": "/usr/bin:/bin"})
    second = _run([str(PYTHON)], FILL + ROS2 % NAMES, environment(77))
    for name in NAMES:
        md5sum, ros1 = first[name][0], bytes.fromhex(first[name][1])
        ros2 = bytes.fromhex(second[name])
        assert TYPES[name].md5sum == md5sum
        assert converted(TYPES[name], ros2, 2, 1) == ros1
        # not byte by byte: rclpy's padding is not zero, and it pads the end to four bytes
        made = converted(TYPES[name], ros1, 1, 2)
        assert 0 <= len(ros2) - len(made) < 4
        assert decode(TYPES[name], made, 2) == decode(TYPES[name], ros2, 2)


def _run(command: list[str], program: str, environ: dict[str, str]) -> dict[str, Any]:
    done = subprocess.run([*command, "-c", program], env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_numbers_of_a_big_endian_sender_are_understood() -> None:
    little = encode(TYPES["std_msgs/Float64"], {"data": 1.5}, 2)
    big = b"\0\0\0\0" + little[4:][::-1]
    assert decode(TYPES["std_msgs/Float64"], big, 2) == {"data": 1.5}


@pytest.mark.parametrize("data", [b"", b"\5\0\0\0abc", b"\1\0\0\0ab"])
def test_bytes_that_are_no_message_are_refused(data: bytes) -> None:
    with pytest.raises(CodecError):
        decode(TYPES["std_msgs/String"], data, 1)


def test_a_robot_of_the_other_version_receives_declared_types_only() -> None:
    text = TYPES["std_msgs/String"]
    ros1, ros2 = encode(text, {"data": "hi"}, 1), encode(text, {"data": "hi"}, 2)
    old = Relay("bob", "bridge/ros1", ros_version=1, nonce=b"b")
    new = Relay("bob", "bridge/ros2", ros_version=2, nonce=b"b")
    name, kind1, kind2 = "/alice/mesh_comm/bob/status", f"std_msgs/String {text.md5sum}", "std_msgs/msg/String"
    assert old.from_mesh("alice", "status", f"{kind2} reliable:volatile:10:", ros2, 0.0) == [
        ToRos(name, TypeKey("std_msgs/String", text.md5sum), "string data\n", False, ros1)
    ]
    (made,) = new.from_mesh("alice", "status", f"{kind1} latched:ab:1", ros1, 0.0)
    assert made == ToRos(name, TypeKey(kind2, "reliable:transient_local:1:"), None, True, ros2)
    (note,) = new.from_mesh("alice", "status", "made_up/Thing 00", ros1, 0.0)
    assert isinstance(note, Note)
    assert "made_up/Thing is not declared" in note.text
    (other,) = new.from_mesh("alice", "map", "std_msgs/String 0123", ros1, 0.0)
    assert isinstance(other, Note)
    assert "expected md5sum" in other.text


def test_an_invalid_file_is_refused_with_every_line() -> None:
    with pytest.raises(BridgeConfigurationError) as refused:
        parse_configuration("topics:\n  map: { depth: 0 }\nservices:\n  reset: {}\nspeed: 1\n", "bridge.yaml")
    lines = str(refused.value).splitlines()
    assert {line.split(": ")[0] for line in lines} == {"bridge.yaml:2:17", "bridge.yaml:4:3", "bridge.yaml:5:1"}


def test_an_array_of_another_length_is_refused() -> None:
    with pytest.raises(CodecError, match="expected 36 elements"):
        encode(TYPES["nav_msgs/Odometry"], {"pose": {"covariance": numbers("float64", [1.0])}}, 1)
