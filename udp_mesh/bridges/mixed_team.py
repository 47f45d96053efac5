"""Converts messages between ROS 1 and ROS 2, for the types that are declared. Pure.

The receiver converts, so that a topic crosses the mesh once for robots of both versions. From ROS 1 the md5sum has to
be that of the declared definition; from ROS 2 the bytes have to match it in length and structure, because ROS 2's type
hash says nothing about ROS 1. A message that is latched in one version is latched in the other.
"""

from __future__ import annotations

from typing import Mapping, Tuple

from udp_mesh.bridges.message_codec import CodecError, converted
from udp_mesh.bridges.message_definition import MessageDefinition
from udp_mesh.bridges.ros2.quality import Quality, quality_text
from udp_mesh.bridges.types import TypeKey


class ConversionError(ValueError):
    """This message cannot be converted."""


def ros2_type(name: str) -> str:
    """`nav_msgs/Odometry` -> `nav_msgs/msg/Odometry`."""
    return name.replace("/", "/msg/", 1)


def ros1_type(name: str) -> str:
    """`nav_msgs/msg/Odometry` -> `nav_msgs/Odometry`."""
    return name.replace("/msg/", "/", 1)


def to_ros2(
    types: Mapping[str, MessageDefinition], key: TypeKey, payload: bytes, *, latched: bool
) -> Tuple[TypeKey, bytes]:
    """A ROS 1 message -> its ROS 2 type with quality of service, and CDR. Raises ConversionError."""
    definition = _declared(types, key.name)
    if key.checksum not in ("", definition.md5sum):
        raise ConversionError("expected md5sum {}, found {}".format(definition.md5sum, key.checksum))
    quality = Quality(durability="transient_local", depth=1) if latched else Quality()
    return TypeKey(ros2_type(key.name), quality_text(quality)), _converted(definition, payload, 1, 2)


def to_ros1(types: Mapping[str, MessageDefinition], key: TypeKey, payload: bytes) -> Tuple[MessageDefinition, bytes]:
    """A ROS 2 message -> its definition in ROS 1, and bytes. Raises ConversionError."""
    definition = _declared(types, ros1_type(key.name))
    return definition, _converted(definition, payload, 2, 1)


def _declared(types: Mapping[str, MessageDefinition], name: str) -> MessageDefinition:
    if name not in types:
        raise ConversionError("{} is not declared for robots of both ROS versions".format(name))
    return types[name]


def _converted(definition: MessageDefinition, payload: bytes, source: int, target: int) -> bytes:
    try:
        return converted(definition, payload, source, target)
    except CodecError as error:
        raise ConversionError(str(error)) from error
