"""The daemon's conditions as the message `udp_mesh_msgs/Conditions`, for ROS 1 and ROS 2. Pure, but for its definition.

The definition is read from the package's own files, so that a robot that builds it has the same one. With ROS 1 a
publisher does not need the package; rclpy publishes only what is built.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, List, Mapping, Optional, Tuple

from udp_mesh.bridges.message_codec import Message, encode, numbers
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.message_types import TYPES, contained
from udp_mesh.bridges.mixed_team import ros2_type
from udp_mesh.bridges.relay import ToRos
from udp_mesh.bridges.ros2.quality import Quality, quality_text
from udp_mesh.bridges.type_hash import type_hash
from udp_mesh.bridges.types import TypeKey

PACKAGE = "udp_mesh_msgs"
FOLDER = Path(__file__).with_name(PACKAGE)
NAN = float("nan")
TRENDS = {"improving": 1, "steady": 2, "worsening": 3}
"""The constants of PeerConditions and RadioPath; 0 is unknown."""
_MEASURED = ("signal_dbm", "noise_dbm", "margin_db", "bottleneck_bits_per_s", "quality", "age_s")
TEXT_TOPIC, TYPED_TOPIC = "mesh_conditions", "mesh_conditions_typed"
"""In the robot's namespace."""


_PARTS = ("PeerConditions", "QueueConditions", "RadioPath", "RadioConditions", "RadioNeighbor")


def _source(name: str) -> str:
    return (FOLDER / "msg" / (name + ".msg")).read_text(encoding="utf-8")


DEFINITION = MessageDefinition(
    PACKAGE + "/Conditions",
    _source("Conditions")
    + "".join(contained("{}/{}".format(PACKAGE, name), _source(name)) for name in _PARTS)
    + contained("std_msgs/Header"),
)
TYPE_HASH = type_hash(DEFINITION)


def conditions_message(conditions: Mapping[str, Any], stamp: Tuple[int, int]) -> Message:
    """The JSON of `~mesh/conditions` as values; `stamp` is in seconds and nanoseconds. Fields that an earlier daemon
    does not have are unknown."""
    return {
        "header": {"stamp": stamp},
        "name": conditions["name"],
        "sent_bits_per_s": conditions["sent_bits_per_s"],
        "heard_bits_per_s": conditions["heard_bits_per_s"],
        "peers": [_peer(peer) for peer in conditions["peers"]],
        "radio": _radio(conditions.get("radio") or {}),
    }


def _peer(peer: Mapping[str, Any]) -> Message:
    trend = peer.get("trend") or {}
    waiting: List[Message] = [
        {
            "priority": queue["priority"],
            "messages": queue["messages"],
            "bytes": queue["bytes"],
            "oldest_s": queue["oldest_s"],
            "drained_in_s": _known(queue.get("drained_in_s")),
        }
        for queue in peer["queues"]
        if queue["messages"]
    ]
    return {
        "name": peer["name"],
        "online": peer["online"],
        "via": list(peer.get("via") or ()),
        "heard_ago_s": _known(peer["heard_ago_s"]),
        "unanswered_for_s": peer["unanswered_for_s"] or 0.0,
        "round_trip_s": _known(peer["round_trip_s"]),
        "loss": peer["loss"],
        "capacity_bits_per_s": _known(peer["capacity_bits_per_s"]),
        "available_bits_per_s": numbers("float64", list(peer.get("available_bits_per_s") or ())),
        "trend": TRENDS.get(trend.get("direction", ""), 0),
        "change_per_s": _known(trend.get("change_per_s")),
        "queues": waiting,
        "outbox_messages": peer["outbox_messages"],
        "outbox_bytes": peer["outbox_bytes"],
        "radio": _radio_path(peer.get("radio") or {}),
    }


def _radio_path(radio: Mapping[str, Any]) -> Message:
    """One path of a collector's report; empty: nothing is known."""
    trend = radio.get("trend") or {}
    names: Message = {key: radio.get(key) or "" for key in ("source", "radio", "next_hop")}
    measured = {key: _known(radio.get(key)) for key in _MEASURED}
    return {
        **names,
        **measured,
        "trend": TRENDS.get(trend.get("direction", ""), 0),
        "change_db_per_s": _known(trend.get("change_db_per_s")),
    }


def _radio(radio: Mapping[str, Any]) -> Message:
    """A collector's report; empty: there is none."""
    neighbors: List[Message] = [
        {
            "name": neighbor["name"],
            "radio": neighbor["radio"],
            "signal_dbm": neighbor["signal_dbm"],
            "margin_db": _known(neighbor["margin_db"]),
            "age_s": neighbor["age_s"],
        }
        for neighbor in radio.get("neighbors") or ()
    ]
    return {
        "source": radio.get("source") or "",
        "problem": radio.get("problem") or "",
        "age_s": _known(radio.get("age_s")),
        "neighbors": neighbors,
    }


def _known(value: Optional[float]) -> float:
    return NAN if value is None else float(value)


def to_ros(conditions: Mapping[str, Any], namespace: str, ros_version: int, stamp: Tuple[int, int]) -> List[ToRos]:
    """A bridge's two messages: all conditions as JSON in a std_msgs/String, and the typed message."""
    text: Message = {"data": json.dumps(conditions, sort_keys=True)}
    found = {
        TEXT_TOPIC: (TYPES["std_msgs/String"], text),
        TYPED_TOPIC: (DEFINITION, conditions_message(conditions, stamp)),
    }
    return [
        ToRos(
            "{}/{}".format(namespace, topic),
            _key(definition, ros_version),
            definition.text if ros_version == 1 else None,
            False,
            encode(definition, message, ros_version),
        )
        for topic, (definition, message) in found.items()
    ]


def _key(definition: MessageDefinition, ros_version: int) -> TypeKey:
    if ros_version == 1:
        return TypeKey(definition.name, definition.md5sum)
    quality = Quality(depth=1, type_hash=TYPE_HASH if definition is DEFINITION else "")
    return TypeKey(ros2_type(definition.name), quality_text(quality))
