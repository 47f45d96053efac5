"""Transforms of one robot are gathered to a rate; those of others are merged and never sent back."""

from __future__ import annotations

from typing import Any

from udp_mesh.bridges.message_codec import decode, encode
from udp_mesh.bridges.transforms import DEFINITION, TF, TF_STATIC, TransformGatherer

ROS_2 = 2


def message(child: str, x: float = 0.0) -> bytes:
    transform = {
        "header": {"stamp": (1, 2), "frame_id": "map"},
        "child_frame_id": child,
        "transform": {
            "translation": {"x": x, "y": 0.0, "z": 0.0},
            "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
        },
    }
    return encode(DEFINITION, {"transforms": [transform]}, ROS_2)


def children(data: bytes) -> dict[str, float]:
    transforms: list[Any] = decode(DEFINITION, data, ROS_2)["transforms"]
    return {one["child_frame_id"]: one["transform"]["translation"]["x"] for one in transforms}


def test_the_newest_transform_of_each_frame_is_sent_at_the_configured_rate() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    sent = []
    for step in range(1000):  # ten seconds at 100 Hz
        gatherer.add(message("base_link", step), static=False)
        gatherer.add(message("arm", -step), static=False)
        if TF in (due := gatherer.due(step / 100)):
            sent.append(children(due[TF]))
    assert 45 <= len(sent) <= 50
    assert sent[1] == {"base_link": 20, "arm": -20}


def test_a_frame_that_stands_still_is_not_repeated() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    gatherer.add(message("base_link"), static=False)
    assert TF in gatherer.due(0.0)
    assert gatherer.due(10.0) == {}


def test_static_transforms_are_sent_all_together_whenever_one_changes() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    gatherer.add(message("lidar", 1), static=True)
    assert children(gatherer.due(0.0)[TF_STATIC]) == {"lidar": 1}
    gatherer.add(message("lidar", 1), static=True)
    assert gatherer.due(0.01) == {}
    gatherer.add(message("camera", 2), static=True)
    assert children(gatherer.due(0.02)[TF_STATIC]) == {"lidar": 1, "camera": 2}


def test_merged_static_transforms_of_several_robots_are_published_together() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    gatherer.merge(message("husky1/lidar", 1), "husky1", static=True)
    published = gatherer.merge(message("husky2/lidar", 2), "husky2", static=True)
    assert children(published) == {"husky1/lidar": 1, "husky2/lidar": 2}


def test_a_merged_frame_that_ros_hands_back_is_not_sent_to_the_mesh() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    for static in (False, True):
        gatherer.merge(message("husky1/base"), "husky1", static=static)
        gatherer.add(message("husky1/base"), static=static)
    assert gatherer.due(0.0) == {}


def test_frames_of_a_robot_that_joined_the_graph_are_local() -> None:
    gatherer = TransformGatherer(ROS_2, rate_hz=5)
    for robot in ("husky1", "husky2"):
        gatherer.merge(message(f"{robot}/lidar"), robot, static=True)
    gatherer.forget("husky1")
    for robot in ("husky1", "husky2"):
        gatherer.add(message(f"{robot}/lidar"), static=True)
    assert set(children(gatherer.due(0.0)[TF_STATIC])) == {"husky1/lidar"}
    assert set(children(gatherer.merge(message("husky3/lidar"), "husky3", static=True))) == {
        "husky2/lidar",
        "husky3/lidar",
    }
