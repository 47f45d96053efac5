"""Takes a robot's position from ROS to its daemon: odometry or a tf chain, once a second. For both ROS versions."""

from __future__ import annotations

import logging
import threading
import time
from typing import Optional, Sequence, Tuple

from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.odometry import Pose, PositionThrottle, TransformTree, odometry_pose, transforms
from udp_mesh.client.mesh_client import MeshError

log = logging.getLogger(__name__)

ODOMETRY_TYPE, TF_TYPE = "nav_msgs/Odometry", "tf2_msgs/TFMessage"
TF_TOPICS = ("/tf", "/tf_static")


class PositionInput:
    """`odometry` is a topic; `frames` are the map's frame and the robot's for tf. Called by the middleware's
    threads."""

    def __init__(self, daemon: DaemonClient, ros_version: int, odometry: str, frames: Sequence[str]) -> None:
        self._daemon, self._ros_version = daemon, ros_version
        self._frames: Optional[Tuple[str, str]] = (frames[0], frames[1]) if len(frames) == 2 else None
        self.topics = {odometry: ODOMETRY_TYPE} if odometry else {}
        if self._frames is not None:
            self.topics.update(dict.fromkeys(TF_TOPICS, TF_TYPE))
        self._tree, self._throttle = TransformTree(), PositionThrottle()
        self._lock = threading.Lock()
        self._refused = ""

    def arrived(self, topic: str, data: bytes) -> None:
        """Handles a message of one of `topics`."""
        with self._lock:
            pose = self._pose(topic, data)
            fields = None if pose is None else self._throttle.request(pose, time.monotonic())
        if fields is None:
            return
        try:
            self._daemon.request("set-position", **fields)
            self._refused = ""
        except MeshError as error:
            # once: a daemon of an earlier version refuses each
            if str(error) != self._refused:
                self._refused = str(error)
                log.warning("position-refused %s", error)

    def _pose(self, topic: str, data: bytes) -> Optional[Pose]:
        if self.topics.get(topic) == ODOMETRY_TYPE:
            return odometry_pose(data, self._ros_version)
        if self._frames is None:
            return None
        for transform in transforms(data, self._ros_version):
            self._tree.add(transform)
        return self._tree.pose(*self._frames)
