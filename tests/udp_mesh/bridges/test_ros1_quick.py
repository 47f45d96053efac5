"""A robot with a real ROS 1 master, bridge and node; the other robot's bridge is played by a client of its daemon."""

from __future__ import annotations

from contextlib import ExitStack

import pytest

from tests.udp_mesh.bridges.ros1_processes import Master, Ros1Bridge, Ros1Node
from tests.udp_mesh.daemon.processes import poll, two_daemons
from udp_mesh.bridges.protocol import TOPIC_SETTINGS, Definition, decode, encode
from udp_mesh.bridges.types import MessageKind, TypeKey, kind_text
from udp_mesh.client.mesh_client import Message

pytestmark = pytest.mark.xdist_group("ros1")

PROTOCOL_TOPIC = "bridge/ros1"
STRING = TypeKey("std_msgs/String", "992ce8a1687cec8c8bd883ec73ca41d1")
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
        node.subscribe("/bob/mesh_comm/alice/status")
        client.publish("status", message.payload, to="alice", type=message.type)
        assert node.expect("data", "ready")["name"] == "/bob/mesh_comm/alice/status"
        # Of a type that is installed nowhere; its definition comes after it.
        node.subscribe("/bob/mesh_comm/alice/map", "*")
        client.publish("map", b"\1\2", to="alice", type=kind_text(MessageKind(MADE)))
        client.publish(PROTOCOL_TOPIC, encode(Definition(MADE, "uint8[2] thing\n")), to="alice", type="bridge")
        thing = node.expect("hex", "0102")
        assert (thing["type"], thing["md5sum"], thing["definition"]) == (*MADE, "uint8[2] thing\n")
