"""Publishers of the ROS 2 bridge, each with the quality of its source. Called on the executor's thread only.

CDR of another definition of the type is garbage: it is not published. A new publisher is connected at once with the
subscribers that the graph already has, so that they get its first message too, if it is reliable.
"""

from __future__ import annotations

from typing import Any, Callable

from rclpy.clock import Clock, ClockType
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from udp_mesh.bridges.relay import ToRos
from udp_mesh.bridges.ros2.quality import MAX_DEPTH, Quality, parse_quality, ros2_name
from udp_mesh.bridges.types import TypeKey

Warn = Callable[[str, str], None]
"""Logs a text once per subject."""


def steady_timer(node: Any, period_s: float, callback: Callable[[], None]) -> Any:
    """A timer of real time. rclpy's own follows `use_sim_time`, and stands still without /clock."""
    return node.create_timer(period_s, callback, clock=Clock(clock_type=ClockType.STEADY_TIME))


def profile(quality: Quality) -> Any:
    """A quality as rclpy's QoSProfile."""
    reliable, latched = quality.reliability == "reliable", quality.latched
    return QoSProfile(
        depth=quality.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def quality_of(info: Any, depth: int | None = None) -> Quality:
    """The quality of an endpoint. `depth` is the configured one, for middlewares that do not report it, such as Fast
    DDS."""
    reliable = info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    # Since Iron; "INVALID" if the middleware does not report it.
    type_hash = str(getattr(info, "topic_type_hash", ""))
    return Quality(
        "reliable" if reliable else "best_effort",
        "transient_local" if latched else "volatile",
        min(depth or info.qos_profile.depth or (1 if latched else 10), MAX_DEPTH),
        type_hash if type_hash.startswith("RIHS") else "",
    )


class _Publisher:
    """One advertised topic. `quality` is what its source offers."""

    def __init__(self, node: Any, message_class: Any, name: str, quality: Quality, warn: Warn) -> None:
        self._node, self._name, self._warn = node, name, warn
        self._source_hash = quality.type_hash
        self._publisher = node.create_publisher(message_class, name, profile(quality))
        self._has_matching_hash: bool | None = None

    def publish(self, payload: bytes) -> None:
        if self._has_matching_hash is None:
            self._compare_hashes()
        if self._has_matching_hash is not False:
            # rclpy takes bytes as a serialized message.
            self._publisher.publish(payload)

    def _compare_hashes(self) -> None:
        """Compares our publisher's type hash with the source's, as soon as the graph lists it."""
        infos = self._node.get_publishers_info_by_topic(self._name)
        hashes = {quality_of(info).type_hash for info in infos if info.node_name == self._node.get_name()} - {""}
        if not self._source_hash:
            self._has_matching_hash = True
        elif hashes:
            self._has_matching_hash = self._source_hash in hashes
        if self._has_matching_hash is False:
            self._warn(
                self._name, "{}: the source has another definition of the type: not published".format(self._name)
            )

    def withdraw(self) -> None:
        self._node.destroy_publisher(self._publisher)


class Ros2Publishers:
    """Publishes messages from the mesh in ROS. `message_class` returns None for a type that is not installed."""

    def __init__(self, node: Any, message_class: Callable[[str], Any], warn: Warn) -> None:
        self._node, self._message_class, self._warn = node, message_class, warn
        self._advertised: dict[str, tuple[TypeKey, _Publisher]] = {}

    def publish(self, message: ToRos) -> None:
        quality, name = parse_quality(message.key.checksum), ros2_name(message.name)
        message_class = self._message_class(message.key.name)
        if quality is None or message_class is None:
            return
        known = self._advertised.get(name)
        if known is None or known[0] != message.key:
            if known is not None:
                known[1].withdraw()
            known = message.key, _Publisher(self._node, message_class, name, quality, self._warn)
            self._advertised[name] = known
        known[1].publish(message.payload)
