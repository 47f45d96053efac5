"""The legacy transport as a ROS 1 node, for the comparison: `SocketLegacyNode` with its ROS names.

python3 -m benchmarks.exploration.legacy_node NAME ADDRESS BROADCAST '{"TOPIC": PRIORITY}' OTHER...
"""

from __future__ import annotations

import json
import sys
from typing import Any

import rospy
from std_msgs.msg import String

from tests.udp_mesh.core.legacy_node import TO_ALL, TYPE, SocketLegacyNode
from udp_mesh.wire.legacy import PriorityMeshData


class RosTopics:
    """The topics of one robot."""

    def __init__(self, name: str, address: str, broadcast: str, priorities: dict[str, int], others: list[str]) -> None:
        self.name = name
        self.node = SocketLegacyNode(name, address, broadcast, self.publish)
        self.publishers: dict[tuple[str, str], Any] = {}
        for topic, priority in priorities.items():
            for other in (TO_ALL, *others):
                part = "" if other == TO_ALL else f"{other}/"
                rospy.Subscriber(
                    f"/{name}/mesh_comm/{part}{topic}", rospy.AnyMsg, self.on_ros, (other, priority, topic)
                )

    def on_ros(self, message: Any, about: tuple[str, int, str]) -> None:
        host, priority, topic = about
        # `_buff` is the message as it was serialized
        self.node.outgoing.put(PriorityMeshData(host, TYPE, priority, topic, message._buff))

    def publish(self, source: str, message: PriorityMeshData) -> None:
        made = String()
        made.deserialize(message.data)
        place = (source, message.topic)
        if place not in self.publishers:
            name = f"/{source}/mesh_comm/{self.name}/{message.topic}"
            self.publishers[place] = rospy.Publisher(name, String, queue_size=10)
        self.publishers[place].publish(made)


def main() -> None:
    name, address, broadcast, priorities, *others = sys.argv[1:]
    rospy.init_node("rudp_mesh", disable_signals=True)
    topics = RosTopics(name, address, broadcast, json.loads(priorities), others)
    sys.stdout.write('{"ready": true}\n')
    sys.stdout.flush()
    while not rospy.is_shutdown():
        topics.node.turn()


if __name__ == "__main__":
    main()
