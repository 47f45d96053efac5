"""Positions out of ROS messages: `nav_msgs/Odometry` and `tf2_msgs/TFMessage` as bytes -> set-position. Pure.

Only the fields that are needed are read; `message_codec` reads whole messages. A tf chain is followed from the robot's
frame to the map's.
"""

from __future__ import annotations

import math
import struct
from typing import Dict, NamedTuple, Optional, Tuple

from udp_mesh.bridges.message_codec import MessageReader

PERIOD_S = 1.0
"""A position is set at most this often: the daemon sends it every two seconds."""
MAX_TRANSFORMS = 1000
MAX_CHAIN = 64

Vector = Tuple[float, float, float]
Quaternion = Tuple[float, float, float, float]


class Pose(NamedTuple):
    """A place in a coordinate frame, and the time of its measurement (Unix, seconds)."""

    frame: str
    x_m: float
    y_m: float
    z_m: float
    time_s: float


class Transform(NamedTuple):
    """The pose of `child` in `parent`; the quaternion is x, y, z, w."""

    parent: str
    child: str
    translation: Vector
    rotation: Quaternion
    time_s: float


def _text(reader: MessageReader) -> str:
    return reader.text().rstrip("\0")


def _stamped(reader: MessageReader) -> Tuple[float, str]:
    """A std_msgs/Header: time and frame."""
    if reader.ros_version == 1:
        reader.number("I")
    seconds, nanoseconds = reader.time()
    return seconds + nanoseconds / 1e9, _text(reader).lstrip("/")


def odometry_pose(data: bytes, ros_version: int) -> Optional[Pose]:
    """The pose of a `nav_msgs/Odometry`; None for bytes that are none."""
    try:
        reader = MessageReader(data, ros_version)
        time_s, frame = _stamped(reader)
        reader.text()
        x_m, y_m, z_m = reader.values("3d")
    except (struct.error, ValueError):
        return None
    return Pose(frame, x_m, y_m, z_m, time_s) if all(map(math.isfinite, (x_m, y_m, z_m))) else None


def transforms(data: bytes, ros_version: int) -> Tuple[Transform, ...]:
    """The transforms of a `tf2_msgs/TFMessage`; none for bytes that are none."""
    found = []
    try:
        reader = MessageReader(data, ros_version)
        for _ in range(min(reader.number("I"), MAX_TRANSFORMS)):
            time_s, parent = _stamped(reader)
            child = _text(reader).lstrip("/")
            values = reader.values("7d")
            if all(map(math.isfinite, values)):
                x, y, z, qx, qy, qz, qw = values
                found.append(Transform(parent, child, (x, y, z), (qx, qy, qz, qw), time_s))
    except (struct.error, ValueError):
        return ()
    return tuple(found)


class TransformTree:
    """The latest transform of each frame; `pose` follows the chain of parents."""

    def __init__(self) -> None:
        self._by_child: Dict[str, Transform] = {}

    def add(self, transform: Transform) -> None:
        if transform.child in self._by_child or len(self._by_child) < MAX_TRANSFORMS:
            self._by_child[transform.child] = transform

    def pose(self, frame: str, of: str) -> Optional[Pose]:
        """Where the frame `of` is in `frame`; None while the chain is not complete. Its time is that of the newest
        transform: fixed ones are old."""
        place: Vector = (0.0, 0.0, 0.0)
        time_s = 0.0
        for _ in range(MAX_CHAIN):
            if of == frame:
                return Pose(frame, place[0], place[1], place[2], time_s)
            step = self._by_child.get(of)
            if step is None:
                return None
            turned = _rotate(step.rotation, place)
            place = (
                turned[0] + step.translation[0],
                turned[1] + step.translation[1],
                turned[2] + step.translation[2],
            )
            of, time_s = step.parent, max(time_s, step.time_s)
        return None


def _rotate(by: Quaternion, vector: Vector) -> Vector:
    """The vector rotated by a quaternion, normalized: v + 2 q x (q x v + w v)."""
    norm = math.sqrt(sum(part * part for part in by)) or 1.0
    x, y, z, w = (part / norm for part in by)
    vx, vy, vz = vector
    tx = 2 * (y * vz - z * vy)
    ty = 2 * (z * vx - x * vz)
    tz = 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


class PositionThrottle:
    """Chooses the poses that become a `set-position`: at most one per period, in any frame."""

    def __init__(self) -> None:
        self._set_at = -math.inf

    def request(self, pose: Pose, now: float) -> Optional[Dict[str, object]]:
        """The fields of the request, or None if one was set a moment ago; `now` is monotonic."""
        if now - self._set_at < PERIOD_S:
            return None
        self._set_at = now
        fields: Dict[str, object] = {"x_m": pose.x_m, "y_m": pose.y_m, "z_m": pose.z_m, "frame": pose.frame or "odom"}
        # a simulation's clock starts at 0: its times say nothing to the daemon
        if pose.time_s > 1e9:
            fields["time_s"] = pose.time_s
        return fields
