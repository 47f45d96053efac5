"""A robot's ROS node for tests, in ROS's own interpreter: commands as JSON lines in, messages as JSON lines out.

{"subscribe": NAME, "type": TYPE or "*"}, {"publish": NAME, "type": TYPE, "data": VALUE, "latch": BOOL}; what arrives is
{"name", "type", "md5sum", "definition", "latching", "data" (typed) or "hex" (of "*")}. TYPE may be one that is
installed nowhere: then "md5sum" and "definition" stand in the command, and the data is hex.
"""

from __future__ import annotations

import json
import sys
from typing import Any

import roslib.message
import rospy

publishers: dict[Any, Any] = {}
subscribers: list[Any] = []


def say(**fields: object) -> None:
    sys.stdout.write(json.dumps(fields) + "\n")
    sys.stdout.flush()


def arrived(message: Any, name: str) -> None:
    header = message._connection_header
    fields = {"name": name, "type": header["type"], "md5sum": header["md5sum"], "latching": header.get("latching")}
    fields["definition"] = header.get("message_definition")
    if isinstance(message, rospy.AnyMsg):
        fields["hex"] = message._buff.hex()
    else:
        fields["data"] = message.data
    say(**fields)


def subscribe(command: dict[str, Any]) -> None:
    name = command["subscribe"]
    wanted = rospy.AnyMsg if command["type"] == "*" else roslib.message.get_message_class(command["type"])
    subscribers.append(rospy.Subscriber(name, wanted, arrived, callback_args=name))


def publish(command: dict[str, Any]) -> None:
    name, type_name = command["publish"], command["type"]
    if (name, type_name) not in publishers:
        for other in [key for key in publishers if key[0] == name]:
            publishers.pop(other)[0].unregister()
        message_class = roslib.message.get_message_class(type_name) if "md5sum" not in command else None
        if message_class is None:
            fields = {"_type": type_name, "_md5sum": command["md5sum"], "_full_text": command["definition"]}
            message_class = type("Made", (rospy.AnyMsg,), fields)
        publisher = rospy.Publisher(name, message_class, queue_size=10, latch=command.get("latch", False))
        publishers[name, type_name] = publisher, message_class
    publisher, message_class = publishers[name, type_name]
    message = message_class()
    if isinstance(message, rospy.AnyMsg):
        message._buff = bytes.fromhex(command["data"])
    else:
        message.data = command["data"]
    publisher.publish(message)
    say(connections=publisher.get_num_connections())


rospy.init_node(sys.argv[1], disable_signals=True)
say(ready=True)
for line in sys.stdin:
    command = json.loads(line)
    (subscribe if "subscribe" in command else publish)(command)
rospy.signal_shutdown("end of input")
