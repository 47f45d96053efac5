"""The typed conditions: the package's definition against genmsg and rosidl, and what is published."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from tests.udp_mesh.bridges.interpreters import ROS_PYTHON, expects_ros
from tests.udp_mesh.bridges.ros1_processes import ROOT
from tests.udp_mesh.bridges.ros2_processes import PYTHON, environment, expects_ros2
from tests.udp_mesh.core.pair import World, settings
from udp_mesh.bridges.conditions_message import (
    DEFINITION,
    FOLDER,
    TRENDS,
    TYPE_HASH,
    conditions_message,
    to_ros,
)
from udp_mesh.bridges.message_codec import decode, encode
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ros2_type
from udp_mesh.bridges.ros2.quality import parse_quality
from udp_mesh.bridges.type_hash import type_hash
from udp_mesh.core.link_trend import Direction
from udp_mesh.core.settings import Topic
from udp_mesh.daemon.radio_paths import RadioTrend
from udp_mesh.daemon.status import conditions_json

MD5SUM = "771db149af53bb77cf8779bd1290b70c"
HASH = "RIHS01_d07c56e6d4332572b982974bbff54906d6a10df6c420d0176bd88e73d7f5a9d7"
KNOWN_HASHES = {
    "std_msgs/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "std_msgs/Empty": "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    "nav_msgs/Odometry": "3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "sensor_msgs/PointCloud2": "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
    "tf2_msgs/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
}
"""Of the packages of ROS 2, Jazzy."""
RADIO_PATH = {
    "source": "alice-radio",
    "radio": "alice-radio",
    "next_hop": "b02",
    "signal_dbm": -67.0,
    "noise_dbm": None,
    "margin_db": 11.5,
    "bottleneck_bits_per_s": 13e6,
    "quality": None,
    "trend": {"direction": "worsening", "change_db_per_s": -0.5},
    "age_s": 1.25,
}
NEIGHBOR = {"name": "b03", "radio": "alice-radio", "signal_dbm": -80.5, "margin_db": None, "age_s": 2.5}
RADIO = {"source": "alice-radio", "problem": None, "age_s": 0.25, "neighbors": [NEIGHBOR]}
ROS1 = """
import genmsg, io, json, sys
import genpy.dynamic
folder, header, name, text, data = json.loads(sys.stdin.read())
context = genmsg.MsgContext.create_default()
paths = {"udp_mesh_msgs": [folder], "std_msgs": [header]}
spec = genmsg.msg_loader.load_msg_by_type(context, name, paths)
genmsg.msg_loader.load_depends(context, spec, paths)
made = genpy.dynamic.generate_dynamic(name, text)[name]()
made.deserialize(bytes.fromhex(data))
again = io.BytesIO()
made.serialize(again)
print(json.dumps([genmsg.compute_md5(context, spec), made._md5sum, again.getvalue().hex(), str(made.peers[0])]))
"""
BUILT = """
import json, sys
from udp_mesh_msgs.msg import Conditions, RadioPath
made = Conditions()
made.deserialize(bytes.fromhex(sys.stdin.read()))
path, (neighbor,) = made.peers[0].radio, made.radio.neighbors
assert path.trend == RadioPath.WORSENING
print(json.dumps([made._md5sum, path.next_hop, path.trend, neighbor.name, neighbor.signal_dbm]))
"""
ROS2 = """
import json, pathlib, sys
from rosidl_adapter.msg import convert_msg_to_idl
from rosidl_generator_type_description import generate_type_hash
folder, out, share = map(pathlib.Path, sys.argv[1:])
names = sorted(path.name for path in (folder / "msg").glob("*.msg"))
for name in names:
    convert_msg_to_idl(folder, "udp_mesh_msgs", pathlib.Path("msg") / name, out / "msg")
arguments = {"package_name": "udp_mesh_msgs", "output_dir": str(out / "made")}
arguments["idl_tuples"] = ["%s:msg/%s" % (out, name.replace(".msg", ".idl")) for name in names]
packages = ("std_msgs", "builtin_interfaces")
arguments["include_paths"] = ["%s:%s" % (package, share / package) for package in packages]
(out / "arguments.json").write_text(json.dumps(arguments))
generate_type_hash(str(out / "arguments.json"))
made = json.loads((out / "made" / "msg" / "Conditions.json").read_text())
print(json.dumps({each["type_name"]: each["hash_string"] for each in made["type_hashes"]}))
"""


def daemon_conditions() -> dict[str, Any]:
    """Of a robot whose link gets slower, with something waiting."""
    world = World()
    for name in ("alice", "bob"):
        world.add(settings(name, Topic("bulk", priority=12)))
    world.run(1.5)
    for pipe in world.pipes.values():
        pipe.rate_bits_per_s = 4e6
    world.send("alice", "bulk", bytes(20_000_000), "bob")
    for _ in range(20):
        world.run(1.0)
        for pipe in world.pipes.values():
            pipe.rate_bits_per_s *= 0.93
    found = conditions_json(world.nodes["alice"].conditions(world.now))
    return json.loads(json.dumps(found))  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def conditions() -> dict[str, Any]:
    return daemon_conditions()


def test_md5sum_and_type_hash_are_the_ones_that_robots_have() -> None:
    assert (DEFINITION.md5sum, TYPE_HASH) == (MD5SUM, HASH)


@pytest.mark.parametrize("name", KNOWN_HASHES)
def test_the_type_hash_of_a_known_message_is_that_of_its_package(name: str) -> None:
    assert type_hash(TYPES[name]) == "RIHS01_" + KNOWN_HASHES[name]


def test_a_comment_or_constant_does_not_change_the_type_hash_and_a_field_does() -> None:
    plain = MessageDefinition("a/B", "uint8 x\nfloat32[3] y\nstring[] z\nduration d\n")
    commented = MessageDefinition("a/B", "# why\nuint8 BIG=3\nuint8 x\nfloat32[3] y\nstring[] z\nduration d\n")
    assert type_hash(plain) == type_hash(commented)
    assert type_hash(plain) != type_hash(MessageDefinition("a/B", "uint8 x\nfloat32[4] y\nstring[] z\nduration d\n"))


@pytest.mark.skipif(not expects_ros(), reason="needs scripts/setup-ros")
def test_genmsg_agrees_with_the_md5sum_and_genpy_reads_the_message(tmp_path: Path, conditions: dict[str, Any]) -> None:
    # Debian installs no definitions beside the generated classes
    (tmp_path / "Header.msg").write_text("uint32 seq\ntime stamp\nstring frame_id\n")
    _, typed = to_ros(_with_radio(conditions), "/alice", 1, (7, 9))
    given = json.dumps([str(FOLDER / "msg"), str(tmp_path), DEFINITION.name, typed.definition, typed.payload.hex()])
    of_files, of_text, again, peer = json.loads(_run([ROS_PYTHON, "-c", ROS1], {"PATH": "/usr/bin:/bin"}, given))
    assert of_files == of_text == MD5SUM
    assert again == typed.payload.hex()
    assert 'name: "bob"' in peer
    assert f"trend: {TRENDS['worsening']}" in peer
    assert "margin_db: 11.5" in peer


@pytest.mark.proof
@pytest.mark.skipif(not expects_ros(), reason="needs scripts/setup-ros")
def test_catkin_builds_the_package_and_its_classes_read_the_message(tmp_path: Path, conditions: dict[str, Any]) -> None:
    shutil.copytree(FOLDER, tmp_path / "src" / FOLDER.name)
    environ = {"PATH": "/usr/bin:/bin", "ROS_VERSION": "1", "HOME": str(tmp_path)}
    arguments = ["/usr/bin/catkin_make", "-C", str(tmp_path), "--cmake-args", f"-DPYTHON_EXECUTABLE={ROS_PYTHON}"]
    _run(arguments, environ, "")
    _, typed = to_ros(_with_radio(conditions), "/alice", 1, (7, 9))
    built = tmp_path / "devel" / "lib" / "python3" / "dist-packages"
    printed = _run([ROS_PYTHON, "-c", BUILT], {**environ, "PYTHONPATH": str(built)}, typed.payload.hex())
    assert json.loads(printed) == [MD5SUM, "b02", TRENDS["worsening"], "b03", -80.5]


@pytest.mark.skipif(not expects_ros2(), reason="needs scripts/setup-ros2")
def test_rosidl_agrees_with_the_type_hash(tmp_path: Path) -> None:
    share = ROOT / ".venv-ros2" / "share"
    (tmp_path / "msg").mkdir()
    printed = _run([str(PYTHON), "-c", ROS2, str(FOLDER), str(tmp_path), str(share)], environment(77), "")
    assert json.loads(printed.splitlines()[-1])[ros2_type(DEFINITION.name)] == HASH


@pytest.mark.skipif(not expects_ros2(), reason="needs scripts/setup-ros2")
def test_type_hashes_are_those_of_the_installed_packages() -> None:
    installed = {
        each["type_name"]: each["hash_string"]
        for file in (ROOT / ".venv-ros2" / "share").glob("*_msgs/msg/*.json")
        for each in json.loads(file.read_text())["type_hashes"]
    }
    compared = {name: type_hash(known) for name, known in TYPES.items() if ros2_type(name) in installed}
    assert len(compared) >= len(TYPES) - 1
    assert compared == {name: installed[ros2_type(name)] for name in compared}


def _with_radio(conditions: dict[str, Any]) -> dict[str, Any]:
    (peer,) = conditions["peers"]
    return {**conditions, "peers": [{**peer, "radio": RADIO_PATH}], "radio": RADIO}


def _run(command: list[str], environ: dict[str, str], given: str) -> str:
    done = subprocess.run(command, env=environ, input=given, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("ros_version", [1, 2])
def test_what_is_published_has_what_the_daemon_says(ros_version: int, conditions: dict[str, Any]) -> None:
    text, typed = to_ros(conditions, "/alice", ros_version, (7, 9))
    assert (text.name, typed.name) == ("/alice/mesh_conditions", "/alice/mesh_conditions_typed")
    assert json.loads(decode(TYPES["std_msgs/String"], text.payload, ros_version)["data"]) == conditions
    message = decode(DEFINITION, typed.payload, ros_version)
    assert (message["header"]["stamp"], message["name"]) == ((7, 9), "alice")
    (peer,), (said,) = message["peers"], conditions["peers"]
    same = ("name", "online", "via", "heard_ago_s", "round_trip_s", "loss", "capacity_bits_per_s", "outbox_bytes")
    assert {key: peer[key] for key in same} == {key: said[key] for key in same}
    assert peer["available_bits_per_s"].values() == said["available_bits_per_s"]
    assert (peer["trend"], peer["change_per_s"]) == (TRENDS["worsening"], said["trend"]["change_per_s"])
    (queue,) = peer["queues"]
    assert queue == {key: said["queues"][0][key] for key in queue}
    if ros_version == 1:
        assert (typed.key.checksum, typed.definition) == (MD5SUM, DEFINITION.text)
    else:
        quality = parse_quality(typed.key.checksum)
        assert quality is not None
        assert (typed.key.name, quality.type_hash) == ("udp_mesh_msgs/msg/Conditions", HASH)


def test_what_is_not_known_is_nan_and_an_earlier_daemon_says_less(conditions: dict[str, Any]) -> None:
    (peer,) = conditions["peers"]
    early = {key: value for key, value in peer.items() if key not in ("via", "trend", "available_bits_per_s")}
    early.update(round_trip_s=None, capacity_bits_per_s=None, heard_ago_s=None, unanswered_for_s=None)
    early["queues"] = [{key: value for key, value in peer["queues"][0].items() if key != "drained_in_s"}]
    message = conditions_message({**conditions, "peers": [early]}, (7, 9))
    (read,) = decode(DEFINITION, encode(DEFINITION, message, 1), 1)["peers"]
    unknown = ("round_trip_s", "capacity_bits_per_s", "heard_ago_s", "change_per_s")
    assert all(math.isnan(read[key]) for key in unknown)
    assert math.isnan(read["queues"][0]["drained_in_s"])
    assert (read["via"], read["available_bits_per_s"].values(), read["trend"]) == ([], [], 0)
    assert read["unanswered_for_s"] == 0


def test_every_direction_of_a_trend_has_its_constant() -> None:
    assert set(TRENDS) == {direction.value for direction in Direction}
    assert set(TRENDS) == {direction.value for direction in RadioTrend}
    for message in ("PeerConditions", "RadioPath"):
        source = (FOLDER / "msg" / f"{message}.msg").read_text()
        assert all(f"uint8 {name.upper()}={number}\n" in source for name, number in TRENDS.items())


def test_the_build_files_name_every_message() -> None:
    build = (FOLDER / "CMakeLists.txt").read_text()
    for path in (FOLDER / "msg").glob("*.msg"):
        assert f'"msg/{path.name}"' in build
        assert f" {path.name}" in build


@pytest.mark.parametrize("ros_version", [1, 2])
def test_the_values_of_a_collector_are_in_the_json_and_in_the_message(
    ros_version: int, conditions: dict[str, Any]
) -> None:
    given = _with_radio(conditions)
    text, typed = to_ros(given, "/alice", ros_version, (1, 2))
    assert json.loads(decode(TYPES["std_msgs/String"], text.payload, ros_version)["data"]) == given
    message = decode(DEFINITION, typed.payload, ros_version)
    path = message["peers"][0]["radio"]
    same = ("source", "radio", "next_hop", "signal_dbm", "margin_db", "bottleneck_bits_per_s", "age_s")
    assert {key: path[key] for key in same} == {key: RADIO_PATH[key] for key in same}
    assert (path["trend"], path["change_db_per_s"]) == (TRENDS["worsening"], -0.5)
    assert math.isnan(path["noise_dbm"])
    assert math.isnan(path["quality"])
    radio = message["radio"]
    assert (radio["source"], radio["problem"], radio["age_s"]) == ("alice-radio", "", 0.25)
    (neighbor,) = radio["neighbors"]
    assert math.isnan(neighbor.pop("margin_db"))
    assert neighbor == {key: value for key, value in NEIGHBOR.items() if key != "margin_db"}


@pytest.mark.parametrize("missing", [{}, {"radio": None}])
def test_without_a_collector_and_with_an_earlier_daemon_the_radio_is_unknown(
    missing: dict[str, None], conditions: dict[str, Any]
) -> None:
    (peer,) = conditions["peers"]
    given = {**conditions, "peers": [{**peer, **missing}], **missing}
    message = decode(DEFINITION, encode(DEFINITION, conditions_message(given, (1, 2)), 1), 1)
    path, radio = message["peers"][0]["radio"], message["radio"]
    assert (path["source"], path["next_hop"], path["trend"], math.isnan(path["margin_db"])) == ("", "", 0, True)
    assert (radio["source"], radio["problem"], radio["neighbors"], math.isnan(radio["age_s"])) == ("", "", [], True)
