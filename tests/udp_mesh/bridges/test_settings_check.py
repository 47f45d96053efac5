"""What the bridges say about topics, options and types that a user spelled differently, and a second bridge."""

from __future__ import annotations

import logging

import pytest

from udp_mesh.bridges import mesh_calls
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.mesh_calls import MeshCalls
from udp_mesh.bridges.once_log import MAX_LOGGED, OnceLog
from udp_mesh.bridges.reduction import JpegOptions, Reduction
from udp_mesh.bridges.ros2.interfaces import interface_class, unknown_type
from udp_mesh.bridges.ros2.shared_graph import DoubleBridge
from udp_mesh.bridges.settings_check import log, settings_without_effect, unread_names
from udp_mesh.bridges.types import MeshTopic

START = "/ugv1/mesh_comm/"
TOPICS = {"map": MeshTopic(), "camera": MeshTopic(keep_last=1), "bridge/ros1": MeshTopic()}


def test_a_name_that_nothing_reads_is_reported_with_what_could_be_meant() -> None:
    published = [f"{START}maps", f"{START}map", "/ugv2/mesh_comm/ugv1/map", "/rosout"]
    (line,) = unread_names(START, published, {f"{START}map"}, TOPICS, ["ugv3", "ugv-2"])
    assert line == (
        "not-sent name=/ugv1/mesh_comm/maps expected a topic of the daemon (camera, map) after /ugv1/mesh_comm/, "
        "or a robot that it knows (ugv3, ugv_2) and a topic"
    )


def test_a_long_list_of_topics_is_shortened_and_none_is_said() -> None:
    (line,) = unread_names(START, [f"{START}x"], (), [f"t{number}" for number in range(9)], [])
    assert "(t0, t1, t2, t3, t4, t5, t6, t7, ...)" in line
    assert "knows (none)" in line


def test_a_topic_of_the_file_that_the_daemon_does_not_have_is_reported() -> None:
    assert settings_without_effect(["map", "maps"], {}, TOPICS) == [
        "topic-unknown topic=maps is in the bridge's file, but not one of the daemon's: camera, map"
    ]


@pytest.mark.parametrize(
    ("topic", "found"),
    [
        (MeshTopic(), "reliable, keep_last = none"),
        (MeshTopic(keep_last=3), "reliable, keep_last = 3"),
        (MeshTopic(reliable=False, keep_last=1), "best effort"),
    ],
)
def test_adapt_names_what_its_topic_lacks(topic: MeshTopic, found: str) -> None:
    adapting = {"camera": Reduction(1.0, JpegOptions(60), adapt=True), "map": Reduction(1.0)}
    (line,) = settings_without_effect(adapting, adapting, {"camera": topic, "map": MeshTopic()})
    assert line.startswith("adapt-refused topic=camera ")
    assert line.endswith(f"found {found}")


def test_nothing_is_said_about_a_topic_that_can_adapt() -> None:
    adapting = {"camera": Reduction(1.0, JpegOptions(60), adapt=True)}
    assert settings_without_effect(adapting, adapting, TOPICS) == []


def test_each_line_is_logged_once_and_not_without_bound(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        lines = OnceLog(log)
        for _ in range(2):
            lines.warn(f"line {number}" for number in range(MAX_LOGGED + 5))
    assert len(caplog.records) == MAX_LOGGED


def test_a_service_without_a_server_is_reported_once_it_had_time_to_start(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = MeshCalls(DaemonClient("/nonexistent"), "bridge/ros1-calls", "run")
    calls.note_missing("service", ["/get_map"])
    assert caplog.messages == []
    monkeypatch.setattr(mesh_calls, "PATIENCE_S", 0.0)
    for _ in range(2):
        calls.note_missing("service", ["/get_map"])
    assert caplog.messages == ["not-offered service=/get_map has no server on this robot"]


def test_a_second_bridge_is_reported_once_and_one_that_was_killed_is_not() -> None:
    one, two = [("mesh_bridge", "/a"), ("mesh_bridge", "/b"), ("camera", "/a")], [("mesh_bridge", "/a")] * 2
    found = DoubleBridge("mesh_bridge", "/a")
    looks = [two] * (DoubleBridge.PATIENCE - 1) + [one] + [two] * (DoubleBridge.PATIENCE + 5)
    assert [found.is_new(nodes) for nodes in looks].count(True) == 1


def test_a_type_that_is_not_installed_says_what_to_install_and_a_wrong_name_does_not() -> None:
    with pytest.raises(ModuleNotFoundError) as missing:
        interface_class("my_msgs_of_nobody/msg/Gas", "msg")
    assert unknown_type("my_msgs_of_nobody/msg/Gas", missing.value).endswith(
        ": install my_msgs_of_nobody on this robot, or source the workspace that has it, and restart the bridge"
    )
    with pytest.raises(ValueError, match="expected PACKAGE/msg/TYPE") as wrong:
        interface_class("os/path", "msg")
    assert "install" not in unknown_type("os/path", wrong.value)
