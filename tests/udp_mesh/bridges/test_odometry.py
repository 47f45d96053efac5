"""Positions out of ROS messages as both versions serialize them."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.bridges.odometry import (
    PERIOD_S,
    Pose,
    PositionThrottle,
    Transform,
    TransformTree,
    odometry_pose,
    transforms,
)


def ros1_text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def ros1_header(frame: str) -> bytes:
    return struct.pack("<III", 7, 1_700_000_000, 500_000_000) + ros1_text(frame)


class Cdr:
    """Little-endian CDR, written field by field."""

    def __init__(self) -> None:
        self.data = b""

    def add(self, form: str, size: int, *values: float) -> Cdr:
        self.data += b"\0" * (-len(self.data) % size) + struct.pack("<" + form, *values)
        return self

    def text(self, text: str) -> Cdr:
        self.add("I", 4, len(text) + 1)
        self.data += text.encode() + b"\0"
        return self

    def header(self, frame: str) -> Cdr:
        return self.add("iI", 4, 1_700_000_000, 500_000_000).text(frame)

    def message(self) -> bytes:
        return b"\x00\x01\x00\x00" + self.data


@pytest.mark.parametrize("frame", ["map", "odom", "a", "spot1/odom"])
def test_the_pose_of_an_odometry_is_read_in_both_serializations(frame: str) -> None:
    rest = struct.pack("<4d", 0, 0, 0, 1) + bytes(8 * 36 + 8 * 42)
    ros1 = ros1_header(frame) + ros1_text("base_link") + struct.pack("<3d", 1.5, -2.5, 3.0) + rest
    ros2 = Cdr().header(frame).text("base_link").add("3d", 8, 1.5, -2.5, 3.0).message() + rest
    expected = Pose(frame, 1.5, -2.5, 3.0, 1_700_000_000.5)
    assert odometry_pose(ros1, 1) == expected
    assert odometry_pose(ros2, 2) == expected


def test_the_transforms_of_a_message_are_read_in_both_serializations() -> None:
    values = (1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    ros1 = struct.pack("<I", 2)
    ros2 = Cdr().add("I", 4, 2)
    for parent, child in (("/map", "odom"), ("odom", "base_link")):
        ros1 += ros1_header(parent) + ros1_text(child) + struct.pack("<7d", *values)
        ros2.header(parent).text(child).add("7d", 8, *values)
    for found in (transforms(ros1, 1), transforms(ros2.message(), 2)):
        assert [(one.parent, one.child) for one in found] == [("map", "odom"), ("odom", "base_link")]
        assert found[1].translation == (1.0, 2.0, 3.0)


def test_a_chain_of_transforms_gives_the_place_in_the_map() -> None:
    tree = TransformTree()
    quarter = (0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4))
    tree.add(Transform("odom", "base_link", (2.0, 0.0, 0.5), (0.0, 0.0, 0.0, 1.0), 20.0))
    assert tree.pose("map", "base_link") is None
    # odom is turned to the left, 10 m east of the map's origin
    tree.add(Transform("map", "odom", (10.0, 0.0, 0.0), quarter, 10.0))
    pose = tree.pose("map", "base_link")
    assert pose is not None
    assert (pose.x_m, pose.y_m, pose.z_m) == pytest.approx((10.0, 2.0, 0.5))
    assert pose.time_s == 20.0
    # a circle of frames ends
    tree.add(Transform("base_link", "map", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 1.0))
    assert tree.pose("world", "base_link") is None


@given(st.binary(max_size=300), st.sampled_from([1, 2]))
def test_no_bytes_raise(data: bytes, version: int) -> None:
    for prefix in (b"", b"\x00\x01\x00\x00"):
        odometry_pose(prefix + data, version)
        transforms(prefix + data, version)


def test_a_position_is_set_once_per_second_with_its_time() -> None:
    throttle = PositionThrottle()
    pose = Pose("odom", 1.0, 2.0, 3.0, 1_700_000_000.0)
    asked = [throttle.request(pose, tick / 100) for tick in range(350)]
    assert sum(one is not None for one in asked) == math.ceil(3.5 / PERIOD_S)
    assert asked[0] == {"x_m": 1.0, "y_m": 2.0, "z_m": 3.0, "frame": "odom", "time_s": 1_700_000_000.0}
    simulated = throttle.request(pose._replace(time_s=12.0), 100.0)
    assert simulated is not None
    assert "time_s" not in simulated
