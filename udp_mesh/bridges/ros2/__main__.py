"""The ROS 2 bridge's edge: rclpy's raw subscriptions and publishers, joined to the daemon by the relay.

A timer looks every LOOK_S at the ROS graph (which types are published under our names?) and at the daemon (topics,
peers). Types must be installed on both robots: rclpy makes publishers and subscriptions from their classes only.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import threading
import time
from typing import Any, Sequence

import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from udp_mesh.bridges.exchange import TOPIC_SETTINGS
from udp_mesh.bridges.names import Route, ros_word, routes
from udp_mesh.bridges.port import MeshPort
from udp_mesh.bridges.relay import Effect, Note, Relay, ToMesh, ToRos
from udp_mesh.bridges.ros2.quality import Quality, parse_quality, quality_text
from udp_mesh.bridges.types import TypeKey
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, Frame, MeshError, as_message

log = logging.getLogger(__name__)

EXCHANGE_TOPIC = "bridge/ros2"
LOOK_S = 1.0


def profile(quality: Quality) -> Any:
    """rclpy's profile of a quality."""
    reliable, latched = quality.reliability == "reliable", quality.latched
    return QoSProfile(
        depth=quality.depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def quality_of(info: Any) -> Quality:
    """The quality an endpoint of the graph offers; its depth is not told by the graph."""
    reliable = info.qos_profile.reliability == ReliabilityPolicy.RELIABLE
    latched = info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL
    return Quality(
        "reliable" if reliable else "best_effort", "transient_local" if latched else "volatile", 1 if latched else 10
    )


class Bridge:
    """The running bridge."""

    def __init__(self, node: Any, port: MeshPort, own: str) -> None:
        self._node, self._port, self._own = node, port, own
        self._relay = Relay(own, EXCHANGE_TOPIC, ros_version=2, nonce=os.urandom(16))
        self._lock = threading.RLock()
        self._table: dict[str, Route] = {}
        self._subscriptions: dict[str, tuple[TypeKey, Any]] = {}
        self._publishers: dict[str, tuple[TypeKey, Any]] = {}
        self._unknown: set[str] = set()
        node.create_timer(LOOK_S, self.look)

    def _run(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, ToMesh):
                self._port.publish(effect.topic, effect.payload, effect.peer, effect.type)
            elif isinstance(effect, ToRos):
                self._publish(effect)
            elif isinstance(effect, Note):
                log.warning("%s", effect.text)

    def daemon_up(self) -> None:
        """The port calls this after each connect."""
        self._look_at_daemon()
        online = [peer for peer, is_online in self._port.peers().items() if is_online]
        with self._lock:
            self._run(self._relay.started(online))

    def from_daemon(self, frame: Frame) -> None:
        """The port calls this for each frame."""
        message, header = as_message(frame), frame[0]
        with self._lock:
            if message is not None:
                now = time.monotonic()
                self._run(self._relay.from_mesh(message.source, message.topic, message.type, message.payload, now))
            elif header.get("event") == "peer-online":
                self._run(self._relay.peer_online(str(header["peer"])))

    def look(self) -> None:
        """Every LOOK_S: topics, peers, and what is published under our names."""
        try:
            self._look_at_daemon()
        except MeshError as error:
            log.debug("daemon-unreachable %s", error)
        with self._lock:
            for name, route in self._table.items():
                self._look_at_publishers(name, route)

    def _look_at_daemon(self) -> None:
        topics = self._port.ensure_topics({EXCHANGE_TOPIC: TOPIC_SETTINGS})
        peers = self._port.peers()
        with self._lock:
            self._relay.topics_are(topics)
            self._table = routes(self._own, [topic for topic in topics if not topic.startswith("bridge/")], peers)
            for name in [name for name in self._subscriptions if name not in self._table]:
                self._node.destroy_subscription(self._subscriptions.pop(name)[1])

    def _look_at_publishers(self, name: str, route: Route) -> None:
        found = self._node.get_publishers_info_by_topic(name)
        if not found:
            return
        quality = quality_of(found[0])
        key = TypeKey(str(found[0].topic_type), quality_text(quality))
        known = self._subscriptions.get(name)
        if known is not None and known[0] == key:
            return
        message_class = self._class(key.name)
        if message_class is None:
            return
        if known is not None:
            self._node.destroy_subscription(known[1])

        def arrived(data: bytes) -> None:
            with self._lock:
                self._run(self._relay.from_ros(route, "", key, "", quality.latched, bytes(data)))

        subscription = self._node.create_subscription(message_class, name, arrived, profile(quality), raw=True)
        self._subscriptions[name] = (key, subscription)

    def _publish(self, message: ToRos) -> None:
        quality = parse_quality(message.key.checksum)
        message_class = self._class(message.key.name)
        if quality is None or message_class is None:
            return
        known = self._publishers.get(message.name)
        if known is None or known[0] != message.key:
            if known is not None:
                self._node.destroy_publisher(known[1])
            known = (message.key, self._node.create_publisher(message_class, message.name, profile(quality)))
            self._publishers[message.name] = known
        # rclpy takes bytes for a message that is serialized already.
        known[1].publish(message.payload)

    def _class(self, name: str) -> Any:
        try:
            return get_message(name)
        except (AttributeError, ModuleNotFoundError, ValueError) as error:
            if name not in self._unknown:
                self._unknown.add(name)
                log.warning("type-unknown type=%s %s", name, error)
            return None


def main(argv: Sequence[str] | None = None) -> int:
    """Runs until ROS or a signal ends it."""
    parser = argparse.ArgumentParser(prog="udp_mesh.bridges.ros2", description="ROS 2 over the mesh")
    parser.add_argument("--socket", default=DEFAULT_SOCKET, help="the daemon's socket")
    options, ros_arguments = parser.parse_known_args(argv)
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    port = MeshPort(options.socket, ["*"])
    try:
        own = port.own_name()
    except MeshError as error:
        sys.stderr.write("ros2 bridge: {}\n".format(error))
        return 1
    rclpy.init(args=ros_arguments)
    node = Node("mesh_bridge", namespace="/" + ros_word(own))
    bridge = Bridge(node, port, own)
    stop = threading.Event()
    thread = threading.Thread(target=port.run, args=(stop, bridge.daemon_up, bridge.from_daemon), daemon=True)
    thread.start()
    try:
        while rclpy.ok() and thread.is_alive():
            rclpy.spin_once(node, timeout_sec=LOOK_S)
    except KeyboardInterrupt:
        log.info("interrupted")
    finally:
        stop.set()
        thread.join(5.0)
        node.destroy_node()
        rclpy.try_shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
