"""A robot with a real ROS 1 master, bridge and node; the other robot's bridge is played by a client of its daemon."""

from __future__ import annotations

from contextlib import ExitStack
from io import BytesIO

import pytest
from PIL import Image

from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.daemon.processes import poll, two_daemons
from udp_mesh.bridges.conditions_message import DEFINITION as CONDITIONS
from udp_mesh.bridges.message_codec import decode as decode_message
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.protocol import TOPIC_SETTINGS, Definition, decode, encode
from udp_mesh.bridges.types import MessageKind, TypeKey, kind_text
from udp_mesh.client.mesh_client import Message

pytestmark = pytest.mark.xdist_group("ros1")

PROTOCOL_TOPIC = "bridge/ros1"
REDUCED = """
topics:
  camera: { rate_hz: 2, encode: { quality: 60, min_quality: 10, scale: 0.5 }, adapt: true }
"""
STRING = TypeKey("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")
TEXT = b"\4\0\0\0text"
MADE = TypeKey("made_up/Thing", "0123456789abcdef" * 2)


def test_a_real_ros_node_sends_and_receives_mesh_messages_of_known_and_unknown_types() -> None:
    with two_daemons() as (alice, bob), ExitStack() as kept:
        master = Master(alice.folder, "alice")
        kept.callback(master.stop)
        master.start_bare()
        bridge = Ros1Bridge(master, alice)
        kept.callback(bridge.stop)
        bridge.start()
        node = Ros1Node(master, "alice_node")
        kept.callback(node.close)
        client = kept.enter_context(bob.client())
        client.subscribe("*")
        client.request("set-topic", topic=PROTOCOL_TOPIC, values=TOPIC_SETTINGS)
        heard: list[Message] = []

        def sent() -> Message | None:
            node.publish("/alice/mesh_comm/bob/status", "ready")
            heard.extend(client.messages(0.1))
            return next((message for message in heard if message.topic == "status"), None)

        message = poll(sent, "the message at bob's daemon")
        assert message.type == kind_text(MessageKind(STRING))
        assert message.payload == b"\5\0\0\0ready"
        received = [decode(each.payload) for each in heard if each.topic == PROTOCOL_TOPIC]
        assert Definition(STRING, "string data\n") in [
            each._replace(text=each.text.rstrip() + "\n") for each in received if isinstance(each, Definition)
        ]
        node.subscribe("/alice/mesh_conditions_typed", "*")
        typed = node.expect("name", "/alice/mesh_conditions_typed")
        assert (typed["type"], typed["md5sum"]) == (CONDITIONS.name, CONDITIONS.md5sum)
        conditions = decode_message(CONDITIONS, bytes.fromhex(typed["hex"]), 1)
        assert [(peer["name"], peer["online"]) for peer in conditions["peers"]] == [("bob", True)]
        assert conditions["header"]["stamp"][0] > 0
        node.subscribe("/bob/mesh_comm/alice/status")
        client.publish("status", message.payload, to="alice", type=message.type)
        assert node.expect("data", "ready")["name"] == "/bob/mesh_comm/alice/status"
        # Of a type that is installed nowhere; its definition comes after it.
        node.subscribe("/bob/mesh_comm/alice/map", "*")
        client.publish("map", b"\1\2", to="alice", type=kind_text(MessageKind(MADE)))
        client.publish(PROTOCOL_TOPIC, encode(Definition(MADE, "uint8[2] thing\n")), to="alice", type="bridge")
        thing = node.expect("hex", "0102")
        assert (thing["type"], thing["md5sum"], thing["definition"]) == (*MADE, "uint8[2] thing\n")


def test_a_subscriber_that_was_busy_while_a_topic_changed_its_type_gets_the_new_type() -> None:
    with two_daemons() as (alice, bob), ExitStack() as kept:
        master = Master(alice.folder, "alice")
        kept.callback(master.stop)
        master.start_bare()
        bridge = Ros1Bridge(master, alice)
        kept.callback(bridge.stop)
        bridge.start()
        node = Ros1Node(master, "alice_node")
        kept.callback(node.close)
        client = kept.enter_context(bob.client())
        client.request("set-topic", topic=PROTOCOL_TOPIC, values=TOPIC_SETTINGS)

        def came(topic: str, key: TypeKey, payload: bytes) -> bool:
            client.publish(PROTOCOL_TOPIC, encode(Definition(key, "made for this\n")), to="alice", type="bridge")
            client.publish(topic, payload, to="alice", type=kind_text(MessageKind(key)))
            return any(
                (line.get("name") or "").endswith(topic) and line["type"] == key.name for line in node.received()
            )

        node.subscribe("/bob/mesh_comm/alice/status", "*")
        poll(lambda: came("status", STRING, TEXT), "a message")
        # the bridge publishes with the new type during this, and rospy ignores what it does not connect to at once
        node.subscribe("/bob/mesh_comm/alice/video", "*", delay_s=2.0)
        # once: each message keeps it busy
        client.publish("video", TEXT, to="alice", type=kind_text(MessageKind(STRING)))
        node.expect("name", "/bob/mesh_comm/alice/video")
        poll(lambda: came("video", MADE, b"\1\2"), "a message of the new type")


def test_a_camera_is_throttled_and_sent_as_jpeg_whose_quality_follows_the_outcomes() -> None:
    with two_daemons() as (alice, bob), ExitStack() as kept:
        master = Master(alice.folder, "alice")
        kept.callback(master.stop)
        master.start_bare()
        (alice.folder / "bridge.yaml").write_text(REDUCED)
        with alice.client() as client:
            client.request("set-topic", topic="camera", values={"priority": 9, "keep_last": 1})
        bridge = Ros1Bridge(master, alice)
        kept.callback(bridge.stop)
        bridge.start(arguments=[f"_config:={alice.folder}/bridge.yaml"])
        node = Ros1Node(master, "camera")
        kept.callback(node.close)
        heard = kept.enter_context(bob.client())
        heard.subscribe("camera")
        node.stream("/alice/mesh_comm/bob/camera", "sensor_msgs/Image", 20.0, picture=[64, 48])
        arrived: list[Message] = []

        def enough() -> bool:
            arrived.extend(heard.messages(0.2))
            return len(arrived) >= 4

        poll(enough, "four images at bob's daemon")
        streamed = node.stop_streams()["/alice/mesh_comm/bob/camera"]
        assert len(arrived) < streamed / 4, "two a second of twenty"
        key = TypeKey("sensor_msgs/CompressedImage", TYPES["sensor_msgs/CompressedImage"].md5sum)
        for message in arrived:
            assert message.type == kind_text(MessageKind(key))
            image = decode_message(TYPES[key.name], message.payload, 1)
            assert image["format"] == "jpeg"
            assert Image.open(BytesIO(image["data"].data)).size == (32, 24)
