"""Two robots with a real ROS 2 each, in ROS domains of their own: node, bridge, daemon, and back."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import pytest

from tests.udp_mesh.bridges.ros2_processes import Ros2Bridge, Ros2Node
from tests.udp_mesh.daemon.processes import RunningDaemon, poll, two_daemons
from udp_mesh.bridges.types import MessageKind, TypeKey, kind_text

pytestmark = pytest.mark.xdist_group("ros2")

DOMAINS = {"alice": 71, "bob": 72}
TO_BOB = "/alice/mesh_comm/bob/status"
TO_BOB_MAP = "/alice/mesh_comm/bob/map"
TO_ALICE = "/bob/mesh_comm/alice/status"


@dataclass
class Side:
    daemon: RunningDaemon
    bridge: Ros2Bridge
    node: Ros2Node


@pytest.fixture(scope="module")
def team() -> Iterator[tuple[Side, Side]]:
    with two_daemons() as daemons, ExitStack() as kept:
        sides = []
        for daemon in daemons:
            domain = DOMAINS[daemon.name]
            bridge = Ros2Bridge(daemon, domain)
            kept.callback(bridge.stop)
            bridge.start()
            node = Ros2Node(daemon.folder, f"{daemon.name}_node", domain)
            kept.callback(node.close)
            sides.append(Side(daemon, bridge, node))
        yield sides[0], sides[1]


def test_messages_cross_in_both_directions(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.node.subscribe(TO_BOB)
    alice.node.subscribe(TO_ALICE)
    alice.node.publish_until_received(TO_BOB, "from alice", bob.node)
    bob.node.publish_until_received(TO_ALICE, "from bob", alice.node)


def test_a_late_subscriber_receives_the_last_transient_local_message(team: tuple[Side, Side]) -> None:
    alice, bob = team
    with bob.daemon.client() as client:
        client.subscribe("map")
        alice.node.publish(TO_BOB_MAP, "the map", latched=True)
        poll(lambda: next(iter(client.messages(0.1)), None), "the map at bob's daemon")
    bob.node.subscribe(TO_BOB_MAP, latched=True)
    assert bob.node.expect("data", "the map")["name"] == TO_BOB_MAP


def test_a_killed_bridge_resumes_after_a_restart(team: tuple[Side, Side]) -> None:
    alice, bob = team
    bob.node.subscribe(TO_BOB)
    for side, data in ((alice, "sender restarted"), (bob, "receiver restarted")):
        side.bridge.kill()
        side.bridge.start()
        alice.node.publish_until_received(TO_BOB, data, bob.node)


@pytest.mark.parametrize("name", ["made_up/msg/Thing", "os/path/join", "../msg/String", "std_msgs/msg/Nothing"])
def test_an_uninstalled_type_is_reported_and_does_not_stop_the_bridge(team: tuple[Side, Side], name: str) -> None:
    alice, bob = team
    kind = kind_text(MessageKind(TypeKey(name, "reliable:volatile:10:")))
    with alice.daemon.client() as client:
        client.publish("status", b"\0\1\0\0", to="bob", type=kind)
    poll(lambda: f"type-unknown type={name}" in bob.bridge.log.read_text() or None, "the report")
    bob.node.subscribe(TO_BOB)
    alice.node.publish_until_received(TO_BOB, f"after {name}", bob.node)
