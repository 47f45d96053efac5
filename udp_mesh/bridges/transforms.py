"""Gathers `/tf` and `/tf_static` of a robot into few messages, and merges those of others into its own. Pure.

Many nodes publish transforms, each at its own rate. The newest transform of each frame is kept, and all of them are
sent together `rate_hz` times a second; static ones when they change. A frame that another robot sent is that robot's:
it is never sent back, which is what keeps merged transforms from going around in circles.
"""

from __future__ import annotations

import threading
from typing import Any, Dict, List, Optional

from udp_mesh.bridges.message_codec import CodecError, decode, encode
from udp_mesh.bridges.message_types import TYPES

DEFINITION = TYPES["tf2_msgs/TFMessage"]
TF, TF_STATIC = "tf", "tf_static"
"""Mesh topics; also the names in ROS, after a slash."""
TOPIC_SETTINGS: Dict[str, Dict[str, object]] = {
    TF: {"priority": 4, "reliable": False, "keep_last": 1},
    # a robot that comes later needs the latest ones, too: they are sent again only when they change
    TF_STATIC: {"priority": 4, "reliable": True, "keep_last": 1, "outbox": "last"},
}
MAX_FRAMES = 1000
"""Frames kept, of this robot and of all others together."""


class TransformGatherer:
    """Transforms of one robot; may be used by several threads."""

    def __init__(self, ros_version: int, rate_hz: float) -> None:
        self._ros_version, self._interval_s = ros_version, 1.0 / rate_hz
        self._moving: Dict[str, Any] = {}
        self._changed: Dict[str, Any] = {}
        self._static: Dict[str, Any] = {}
        self._static_changed = False
        self._others: Dict[str, Any] = {}
        self._foreign: Dict[str, str] = {}
        self._sent_at: Optional[float] = None
        self._lock = threading.Lock()

    def add(self, data: bytes, *, static: bool) -> None:
        """Keeps the transforms of a local message; bytes that are none are ignored."""
        with self._lock:
            for transform in self._decoded(data):
                child = transform["child_frame_id"]
                known = self._static if static else self._moving
                if child in self._foreign or (child not in known and len(known) >= MAX_FRAMES):
                    continue
                if static:
                    self._static_changed |= known.get(child) != transform
                else:
                    self._changed[child] = transform
                known[child] = transform

    def due(self, now: float) -> Dict[str, bytes]:
        """Messages to send now (monotonic seconds), by mesh topic."""
        found: Dict[str, bytes] = {}
        with self._lock:
            if self._static_changed:
                self._static_changed = False
                found[TF_STATIC] = self._encoded(list(self._static.values()))
            if self._changed and (self._sent_at is None or now - self._sent_at >= self._interval_s):
                self._sent_at = now
                found[TF] = self._encoded(list(self._changed.values()))
                self._changed = {}
        return found

    def merge(self, data: bytes, source: str, *, static: bool) -> bytes:
        """A message of robot `source` -> the one to publish here: of static ones, all that came, because a late
        subscriber gets a publisher's last message alone."""
        with self._lock:
            transforms = self._decoded(data)
            for transform in transforms:
                child = transform["child_frame_id"]
                if child in self._foreign or len(self._foreign) < MAX_FRAMES:
                    self._foreign[child] = source
                    for own in (self._moving, self._changed, self._static):
                        own.pop(child, None)
                    if static:
                        self._others[child] = transform
            return self._encoded(list(self._others.values()) if static else transforms)

    def forget(self, source: str) -> None:
        """The frames that this robot sent count as local from now on, since its nodes are in the same ROS graph."""
        with self._lock:
            for child in [child for child, robot in self._foreign.items() if robot == source]:
                del self._foreign[child]
                self._others.pop(child, None)

    def _decoded(self, data: bytes) -> List[Any]:
        try:
            return list(decode(DEFINITION, data, self._ros_version)["transforms"])
        except CodecError:
            return []

    def _encoded(self, transforms: List[Any]) -> bytes:
        return encode(DEFINITION, {"transforms": transforms}, self._ros_version)
