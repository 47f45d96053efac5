"""The ROS 2 bridge: rclpy's raw subscriptions and publishers, joined to the daemon by the relay.

Only the executor's thread calls rclpy. Every REFRESH_S a timer reads the ROS graph (types published under our names)
and the daemon (topics, peers). Messages from the daemon client's thread wait in a queue, and a guard condition wakes
the executor for them. Types must be installed on both robots: rclpy needs their classes to create publishers and
subscriptions.
"""

from __future__ import annotations

import argparse
import importlib.util
import logging
import os
import sys
import threading
import time
from collections import deque
from typing import Any, Callable, Deque, Iterable, Mapping, Sequence

from udp_mesh.bridges import settings_check
from udp_mesh.bridges.conditions_message import PACKAGE, to_ros
from udp_mesh.bridges.configuration import (
    EMPTY,
    BridgeConfiguration,
    BridgeConfigurationError,
    TopicOptions,
    load_configuration,
)
from udp_mesh.bridges.daemon_client import CONDITIONS_TOPIC, DaemonClient
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.mixed_team import ros2_type
from udp_mesh.bridges.names import Route, own_prefix, ros_word, routes
from udp_mesh.bridges.once_log import OnceLog
from udp_mesh.bridges.position_input import PositionInput
from udp_mesh.bridges.receiving import Receive, with_needed
from udp_mesh.bridges.reduction import Reducer
from udp_mesh.bridges.relay import PROTOCOL_TOPICS, Relay, ToRos
from udp_mesh.bridges.ros2.quality import Quality, common, in_order_of_arrival, quality_text, ros2_name
from udp_mesh.bridges.ros2.shared_graph import DoubleBridge, other_bridges, shared_graph
from udp_mesh.bridges.runtime import BridgeRuntime
from udp_mesh.bridges.settings_check import settings_without_effect, unread_names
from udp_mesh.bridges.transforms import DEFINITION, TF, TF_STATIC, TOPIC_SETTINGS, TransformGatherer
from udp_mesh.bridges.types import MeshTopic, TypeKey
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, Frame, MeshError

try:
    import rclpy
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.node import Node

    from udp_mesh.bridges.ros2.interfaces import interface_class, unknown_type
    from udp_mesh.bridges.ros2.publishers import Ros2Publishers, profile, quality_of, steady_timer
    from udp_mesh.bridges.ros2.services import Ros2Calls
except ModuleNotFoundError as error:
    raise SystemExit("udp_mesh.bridges.ros2: {} (source /opt/ros/RELEASE/setup.bash first)".format(error)) from error

log = logging.getLogger(__name__)

NODE = "mesh_bridge"
REFRESH_S = 1.0
TF_TICK_S = 0.02
STATIC_TF = Quality(durability="transient_local", depth=1)
MOVING_TF = Quality(depth=100)
"""As tf2_ros subscribes to them."""
MAX_ARRIVED = 1000
"""Messages from the mesh waiting for the executor; the oldest are dropped."""


class Ros2Bridge:
    """The running bridge."""

    def __init__(
        self,
        node: Any,
        daemon: DaemonClient,
        own: str,
        odometry: str = "",
        tf_frames: Sequence[str] = (),
        options: BridgeConfiguration = EMPTY,
    ) -> None:
        self._node, self._daemon, self._own, self._options = node, daemon, own, options
        relay = Relay(own, PROTOCOL_TOPICS[2], ros_version=2, nonce=os.urandom(16), types={**TYPES, **options.types})
        wanted = TOPIC_SETTINGS if options.tf is not None else {}
        self._runtime = BridgeRuntime(daemon, relay, self._to_ros, wanted, Reducer(options.reductions, 2))
        self._calls = Ros2Calls(node, daemon, own, options, os.urandom(8).hex())
        self._gatherer = None if options.tf is None else TransformGatherer(2, options.tf.rate_hz)
        self._arrived: Deque[ToRos] = deque(maxlen=MAX_ARRIVED)
        self._subscriptions: dict[str, tuple[TypeKey, Any]] = {}
        self._publishers = Ros2Publishers(node, self._class, self._warn_once)
        self._came_last: dict[str, dict[bytes, str]] = {}
        self._graph, self._double = shared_graph(own, (), ()), DoubleBridge(NODE, node.get_namespace())
        self._log = OnceLog(settings_check.log)
        self._warned: set[str] = set()
        self._has_conditions_package = importlib.util.find_spec(PACKAGE) is not None
        self._wake = node.create_guard_condition(self.publish_arrived)
        steady_timer(node, REFRESH_S, self.refresh)
        positions = PositionInput(daemon, 2, odometry, tf_frames)
        for name, type_name in positions.topics.items():
            self._watch(name, type_name, positions.arrived)
        if self._gatherer is not None:
            for topic in (TF, TF_STATIC):
                self._watch("/" + topic, DEFINITION.name, self._gather)
            steady_timer(node, TF_TICK_S, self._send_transforms)

    def _gather(self, name: str, data: bytes) -> None:
        if self._gatherer is not None:
            self._gatherer.add(data, static=name.endswith("_static"))

    def _send_transforms(self) -> None:
        if self._gatherer is None or not self._graph.sends_transforms:
            return
        for topic, data in self._gatherer.due(time.monotonic()).items():
            quality = STATIC_TF if topic == TF_STATIC else MOVING_TF
            key = TypeKey(ros2_type(DEFINITION.name), quality_text(quality))
            self._runtime.from_ros(Route(topic, None), "/" + topic, key, "", quality.latched, data)

    def _watch(self, name: str, ros1_name: str, on_bytes: Callable[[str, bytes], None]) -> None:
        """Subscribes to a name for the bridge itself. Best effort matches every publisher; static transforms are
        latched."""
        message_class = self._class(ros2_type(ros1_name))
        if message_class is None:
            return

        def arrived(data: bytes) -> None:
            on_bytes(name, bytes(data))

        static = name.endswith("_static")
        wanted = Quality("reliable" if static else "best_effort", "transient_local" if static else "volatile", 100)
        self._node.create_subscription(message_class, name, arrived, profile(wanted), raw=True)

    def _to_ros(self, message: ToRos) -> None:
        self._arrived.append(message)
        if self._gatherer is not None and self._options.tf is not None and self._options.tf.merge:
            source, topic = ros2_name(message.name).split("/")[1], message.name.rpartition("/")[2]
            is_transform = topic in (TF, TF_STATIC) and message.key.name == ros2_type(DEFINITION.name)
            if is_transform and self._graph.merges_transforms_from(source):
                merged = self._gatherer.merge(message.payload, source, static=topic == TF_STATIC)
                quality = STATIC_TF if topic == TF_STATIC else MOVING_TF
                key = TypeKey(message.key.name, quality_text(quality))
                self._arrived.append(ToRos("/" + topic, key, None, quality.latched, merged))
        self._wake.trigger()

    # The daemon client's thread

    def on_daemon_up(self) -> None:
        """Called by the daemon client after each connect. Raises MeshError."""
        self._runtime.on_daemon_up()
        self._calls.on_daemon_up()

    def on_frame(self, frame: Frame) -> None:
        """Called by the daemon client for each frame."""
        self._runtime.on_frame(frame)
        self._calls.on_frame(frame)
        if frame[0].get("event") == "conditions":
            self._publish_conditions(frame[0]["conditions"])

    def _publish_conditions(self, conditions: Mapping[str, Any]) -> None:
        stamp = divmod(self._node.get_clock().now().nanoseconds, 1_000_000_000)
        messages = to_ros(conditions, "/" + ros_word(self._own), 2, stamp)
        self._arrived.extend(message for message in messages if self._has_package(message))
        self._wake.trigger()

    def _has_package(self, message: ToRos) -> bool:
        """Whether rclpy can publish it: the package of the typed conditions is optional."""
        return not message.key.name.startswith(PACKAGE) or self._has_conditions_package

    # The executor's thread

    def refresh(self) -> None:
        """Every REFRESH_S: updates topics, peers and subscriptions."""
        try:
            topics, peers = self._runtime.refresh_topics(), self._daemon.peers()
        except MeshError as error:
            log.debug("daemon-unreachable %s", error)
            return
        self._refresh_graph(peers)
        found = routes(self._own, [topic for topic in topics if not topic.startswith("bridge/")], peers)
        table = {ros2_name(name): route for name, route in found.items() if self._graph.may_read(ros2_name(name))}
        for name in [name for name in self._subscriptions if name not in table]:
            self._node.destroy_subscription(self._subscriptions.pop(name)[1])
        self._came_last = {name: known for name, known in self._came_last.items() if name in table}
        for name, route in table.items():
            self._refresh_subscription(name, route)
        self._check(found, topics, peers)

    def _check(self, routed: Mapping[str, Route], topics: Mapping[str, MeshTopic], peers: Iterable[str]) -> None:
        """Logs what is published or configured without effect."""
        read = {ros2_name(name) for name in routed}
        space, start = self._node.get_namespace(), ros2_name(own_prefix(self._own)) + "/"
        published = [
            name
            for name, _ in self._node.get_topic_names_and_types()
            # other publishers than this bridge, which offers peers' actions under these names
            if name.startswith(start)
            and name not in read
            and self._graph.may_read(name)
            and any(
                (info.node_name, info.node_namespace) != (NODE, space)
                for info in self._node.get_publishers_info_by_topic(name)
            )
        ]
        self._log.warn(unread_names(start, published, read, topics, peers))
        self._log.warn(settings_without_effect(self._options.topics, self._options.reductions, topics))

    def _refresh_graph(self, peers: Iterable[str]) -> None:
        """Updates which robots' bridges are in this robot's graph."""
        nodes, namespace = self._node.get_node_names_and_namespaces(), self._node.get_namespace()
        if self._double.is_new(nodes):
            log.error("two-bridges: another bridge of this robot is in its graph: each message arrives twice")
        known, self._graph = self._graph, shared_graph(self._own, other_bridges(nodes, NODE, namespace), peers)
        if self._graph.is_shared and self._graph != known:
            log.error(
                "%s; give each robot a ROS_DOMAIN_ID of its own or set ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST",
                self._graph,
            )
        elif known.is_shared and not self._graph.is_shared:
            log.info("bridges-apart: everything is sent over the mesh again")
        if self._gatherer is not None:
            for robot in self._graph.robots:
                self._gatherer.forget(robot)

    def _type_published(self, name: str, infos: Sequence[Any]) -> str:
        listed = {bytes(info.endpoint_gid): str(info.topic_type) for info in infos}
        self._came_last[name] = types = in_order_of_arrival(self._came_last.get(name, {}), listed)
        found = list(types.values())
        if len(set(found)) > 1:
            text = "{}: publishers of {}: only the type that came last is sent"
            self._warn_once(name + " types", text.format(name, " and ".join(sorted(set(found)))))
        return found[-1]

    def _refresh_subscription(self, name: str, route: Route) -> None:
        infos = self._node.get_publishers_info_by_topic(name)
        if not infos:
            return
        type_name = self._type_published(name, infos)
        options = self._options.topics.get(route.topic, TopicOptions())
        quality = common(quality_of(info, options.depth) for info in infos if info.topic_type == type_name)
        key = TypeKey(type_name, quality_text(quality))
        known = self._subscriptions.get(name)
        if known is not None and known[0] == key:
            return
        message_class = self._class(type_name)
        if message_class is None:
            return
        if known is not None:
            self._node.destroy_subscription(known[1])

        def arrived(data: bytes) -> None:
            self._runtime.from_ros(route, name, key, "", quality.latched, bytes(data))

        # At least ten messages cover the time the executor is busy.
        wanted = profile(quality._replace(depth=max(10, quality.depth)))
        self._subscriptions[name] = (
            key,
            self._node.create_subscription(message_class, name, arrived, wanted, raw=True),
        )

    def publish_arrived(self) -> None:
        """Publishes the messages that arrived from the mesh since the last call."""
        while self._arrived:
            self._publishers.publish(self._arrived.popleft())

    def _class(self, name: str) -> Any:
        try:
            return interface_class(name, "msg")
        except (AttributeError, ModuleNotFoundError, ValueError) as error:
            self._warn_once(name, unknown_type(name, error))
            return None

    def _warn_once(self, about: str, text: str) -> None:
        if about not in self._warned:
            self._warned.add(about)
            log.warning("%s", text)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs until ROS or a signal stops it. Waits for the daemon."""
    parser = argparse.ArgumentParser(prog="udp_mesh.bridges.ros2", description="Carry ROS 2 topics over the mesh.")
    parser.add_argument("--socket", default=DEFAULT_SOCKET, help="the daemon's socket (default: %(default)s)")
    parser.add_argument("--odometry", default="", metavar="TOPIC", help="take the robot's position from this topic")
    parser.add_argument(
        "--tf-frames",
        nargs=2,
        default=(),
        metavar=("MAP", "ROBOT"),
        help="take the robot's position from /tf: the map's frame and the robot's",
    )
    parser.add_argument("--config", default="", metavar="FILE", help="the bridge's file (docs/bridges.md)")
    options, ros_arguments = parser.parse_known_args(argv)
    # rclpy ignores what it does not know, so that a misspelled option would have no effect and no message
    if ros_arguments and ros_arguments[0] != "--ros-args":
        parser.error("unrecognized arguments: {} (those for ROS follow --ros-args)".format(ros_arguments[0]))
    try:
        configuration = load_configuration(options.config) if options.config else EMPTY
    except BridgeConfigurationError as error:
        sys.stderr.write("{}\n".format(error))
        return 2
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    merged = [TF, TF_STATIC] if configuration.tf is not None and configuration.tf.merge else []
    received = with_needed(configuration.receive, ["bridge/*", *merged])
    daemon = DaemonClient(options.socket, [*received, Receive(CONDITIONS_TOPIC)])
    stop = threading.Event()
    rclpy.init(args=ros_arguments)
    try:
        own = _wait_for_node_name(daemon)
        if own is None:
            return 0
        node = Node(NODE, namespace=ros2_name("/" + ros_word(own)))
        try:
            bridge = Ros2Bridge(node, daemon, own, options.odometry, options.tf_frames, configuration)
            return _serve(node, bridge, daemon, stop)
        finally:
            # else the graph lists its services and publishers for the 20 s of DDS's lease
            node.destroy_node()
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        stop.set()
        rclpy.try_shutdown()


def _serve(node: Any, bridge: Ros2Bridge, daemon: DaemonClient, stop: threading.Event) -> int:
    """Runs until ROS, a signal or an unexpected exception in the daemon client's thread stops it."""
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    thread = threading.Thread(target=daemon.run, args=(stop, bridge.on_daemon_up, bridge.on_frame), daemon=True)
    thread.start()
    try:
        while rclpy.ok() and thread.is_alive():
            executor.spin_once(timeout_sec=REFRESH_S)
        # The exception was logged; the supervisor restarts this process.
        return 1 if rclpy.ok() else 0
    finally:
        stop.set()
        thread.join(5.0)
        executor.shutdown()


def _wait_for_node_name(daemon: DaemonClient) -> str | None:
    """The daemon's node name, polled until the daemon answers; None if ROS shuts down first."""
    logged = False
    while rclpy.ok():
        try:
            return daemon.node_name()
        except MeshError as error:
            if not logged:
                log.info("waiting-for what=daemon %s", error)
                logged = True
        time.sleep(REFRESH_S)
    return None


if __name__ == "__main__":
    sys.exit(main())
