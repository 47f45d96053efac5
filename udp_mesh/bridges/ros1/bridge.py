"""The ROS 1 bridge: the daemon and the ROS graph, joined by the relay.

Three kinds of threads run here: rospy's (one per connection), the daemon client's, and the main thread, which runs the
relay's timers every TICK_S and refreshes topics, peers and the connection to the master every REFRESH_S. Only the main
thread waits for the master, so that existing traffic continues while the master is down.
"""

from __future__ import annotations

import logging
import os
import sys
import threading
import time
from typing import Callable, Container, Iterable, Mapping

import rosgraph
import rospy

from udp_mesh.bridges import settings_check
from udp_mesh.bridges.call_messages import Offer
from udp_mesh.bridges.configuration import (
    EMPTY,
    BridgeConfiguration,
    BridgeConfigurationError,
    load_configuration,
)
from udp_mesh.bridges.daemon_client import CONDITIONS_TOPIC, DaemonClient
from udp_mesh.bridges.message_types import TYPES
from udp_mesh.bridges.names import (
    Route,
    outbound_name,
    own_prefix,
    parse_topic_list,
    ros_word,
    routes,
    undeclared_route,
)
from udp_mesh.bridges.once_log import OnceLog
from udp_mesh.bridges.position_input import PositionInput
from udp_mesh.bridges.receiving import Receive, with_needed
from udp_mesh.bridges.reduction import Reducer
from udp_mesh.bridges.relay import PROTOCOL_TOPICS, Relay, ToRos
from udp_mesh.bridges.ros1.actions import FEEDBACK, FROM_SERVER, RESULT, STATUS, STATUS_ARRAY, Actions, offer_of
from udp_mesh.bridges.ros1.graph import (
    MASTER_ERRORS,
    Graph,
    Parameters,
    log_to_ros,
    parameters,
    unknown_arguments,
)
from udp_mesh.bridges.ros1.lost_connections import SystemState
from udp_mesh.bridges.ros1.services import Ros1Calls
from udp_mesh.bridges.runtime import BridgeRuntime
from udp_mesh.bridges.settings_check import settings_without_effect, unread_names
from udp_mesh.bridges.types import MeshTopic, TypeKey
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, Frame, MeshError

log = logging.getLogger(__name__)

ANY = "any"
"""The legacy system's topic for messages of any type, at priority 1."""
TICK_S = 0.1
REFRESH_S = 1.0
"""Interval between refreshes of the daemon's topics and peers and of the master."""


class Ros1Bridge:
    """The running bridge."""

    def __init__(self, daemon: DaemonClient, own: str, given: Parameters, options: BridgeConfiguration = EMPTY) -> None:
        self._daemon = daemon
        self._own = own
        self._refresh_requested = threading.Event()
        self._options, self._log = options, OnceLog(settings_check.log)
        self._hosts = {str(host) for host in given.host_list}
        listed, problems = parse_topic_list(given.topic_list)
        for problem in problems:
            log.error("parameter-refused %s", problem)
        wanted = {topic.topic: {"priority": topic.priority} for topic in listed}
        wanted.setdefault(ANY, {"priority": 1})
        types = {**TYPES, **options.types}
        relay = Relay(own, PROTOCOL_TOPICS[1], ros_version=1, nonce=os.urandom(16), types=types)
        self._runtime = BridgeRuntime(daemon, relay, self._to_ros, wanted, Reducer(options.reductions, 1))
        self._actions, self._lost_s = Actions(own, options.actions), options.actions
        self._actions_lock = threading.Lock()
        run = os.urandom(8).hex()
        self._calls = Ros1Calls(daemon, own, options.services, run, self._on_offer, self._on_withdrawn)
        self._master_gone = False
        self._positions = PositionInput(daemon, 1, given.odometry, [str(frame) for frame in given.tf_frames])
        self._graph = Graph(self._from_ros, "/{}/".format(ros_word(own)), self._set_window)

    def start(self, stop: threading.Event) -> None:
        """Starts publishing, until `stop` is set."""
        self._graph.start(stop)
        for name in self._positions.topics:
            self._graph.watch(name, self._positions.arrived)

    def _to_ros(self, message: ToRos) -> None:
        with self._actions_lock:
            name = self._actions.local_name(message.name)
        self._graph.publish(message._replace(name=name))

    def _from_ros(
        self, route: Route, publisher: str, key: TypeKey, definition: str, latched: bool, payload: bytes
    ) -> None:
        with self._actions_lock:
            found = self._actions.from_ros(route, payload, time.monotonic())
        for each in found:
            self._runtime.from_ros(each, publisher, key, definition, latched, payload)

    # Actions

    def _on_offer(self, peer: str, offer: Offer) -> bool:
        with self._actions_lock:
            return self._actions.on_offered(peer, offer) is not None

    def _on_withdrawn(self, peer: str, name: str) -> bool:
        with self._actions_lock:
            return self._actions.on_withdrawn(peer, name, time.monotonic())

    def _action_offers(self) -> list[Offer]:
        """The configured actions whose server is connected."""
        offers = []
        for name, options in self._lost_s.items():
            types = {part: self._graph.publisher_type("{}/{}".format(name, part)) for part in FROM_SERVER}
            known = {part: key for part, key in types.items() if key is not None}
            if len(known) == len(types):
                offers.append(offer_of(name, known, options.lost_s))
            else:
                self._calls.note_missing("action", [name])
        return offers

    def _end_lost_goals(self) -> None:
        with self._actions_lock:
            ended = [(proxy, proxy.lost_statuses()) for proxy in self._actions.lost(time.monotonic())]
        for proxy, statuses in ended:
            log.warning("action-lost peer=%s action=%s its goals may have been executed", proxy.peer, proxy.offer.name)
            for payload in statuses:
                name, key = proxy.names[STATUS], proxy.types[STATUS]
                self._graph.publish(ToRos(name, key, STATUS_ARRAY.text, True, payload))

    # Callbacks

    def on_daemon_up(self) -> None:
        """Called by the daemon client after each connect. Raises MeshError."""
        self._runtime.on_daemon_up()
        self._calls.on_daemon_up()
        self._refresh_requested.set()

    def on_frame(self, frame: Frame) -> None:
        """Called by the daemon client for each frame."""
        self._runtime.on_frame(frame)
        self._calls.on_frame(frame)
        header = frame[0]
        event = header.get("event")
        if event == "conditions":
            self._graph.publish_conditions(header["conditions"])
        elif event == "peer-online":
            self._refresh_requested.set()

    def _set_window(self, packets: int) -> None:
        try:
            self._daemon.request("set-window", window=packets or "adaptive")
        except MeshError as error:
            log.warning("window-unchanged packets=%d %s", packets, error)

    # The main thread

    def run(self, stop: threading.Event) -> None:
        """Runs timers every TICK_S and refreshes every REFRESH_S or on request, until `stop` is set."""
        refreshed_at = 0.0
        while not stop.wait(TICK_S):
            now = time.monotonic()
            self._runtime.tick(now)
            self._calls.tick(now)
            if self._refresh_requested.is_set() or now - refreshed_at >= REFRESH_S:
                self._refresh_requested.clear()
                refreshed_at = now
                self._refresh()

    def _refresh(self) -> None:
        """Registers with a restarted master, and subscribes to the names of the current topics and peers."""
        try:
            self._graph.reregister(self._calls.registrations())
            self._calls.refresh(self._action_offers())
            self._end_lost_goals()
            self._master_gone = False
        except MASTER_ERRORS as error:
            if not self._master_gone:
                log.warning("master-unreachable uri=%s %s", rosgraph.get_master_uri(), error)
            self._master_gone = True
            return
        try:
            with self._actions_lock:
                wanted = self._actions.settings
            topics, undeclared = self._runtime.refresh_topics(wanted), self._daemon.accepts_undeclared()
            peers = {*self._daemon.peers(), *self._hosts}
        except MeshError as error:
            log.debug("daemon-unreachable %s", error)
            return
        declared = [topic for topic in topics if not topic.startswith("bridge/")]
        table = routes(self._own, declared, peers)
        state = self._system_state()
        published = state.publishers
        if undeclared:
            self._add_undeclared(table, peers, published)
        with self._actions_lock:
            self._actions.peers = frozenset(peers)
            table.update(self._actions.routes())
            reserved = {
                proxy.names[part]: proxy.types[part] for proxy in self._actions.proxies() for part in (FEEDBACK, RESULT)
            }
        self._graph.listen(table)
        self._graph.reserve(reserved)
        self._reconnect(state)
        self._check(published, table, topics, peers)

    def _system_state(self) -> SystemState:
        """The topics that other nodes publish and subscribe to; none while there is no master."""
        try:
            return self._graph.system_state()
        except MASTER_ERRORS as error:
            log.debug("master-unreachable %s", error)
            return SystemState({}, {})

    def _reconnect(self, state: SystemState) -> None:
        try:
            self._graph.reconnect(state)
        except MASTER_ERRORS as error:
            log.debug("master-unreachable %s", error)

    def _check(
        self,
        published: Mapping[str, Iterable[str]],
        table: Container[str],
        topics: Mapping[str, MeshTopic],
        peers: Iterable[str],
    ) -> None:
        """Logs what is published or configured without effect, and a second bridge of this robot."""
        for node in published.get("/{}/mesh_status".format(ros_word(self._own)), ()):
            self._log.warn(["two-bridges node={} carries messages of this robot, too: each arrives twice".format(node)])
        self._log.warn(unread_names(own_prefix(self._own) + "/", published, table, topics, peers))
        self._log.warn(settings_without_effect(self._options.topics, self._options.reductions, topics))

    def _add_undeclared(self, table: dict[str, Route], peers: set[str], published: Iterable[str]) -> None:
        """Adds what is published under our prefix, if the daemon accepts any topic."""
        for name in published:
            route = undeclared_route(self._own, name, peers)
            if route is not None and name not in table and outbound_name(self._own, route) == name:
                table[name] = route


def main() -> int:
    """Runs until ROS or a signal stops it. Waits for a master and for the daemon."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    unknown = unknown_arguments(sys.argv[1:])
    if unknown:
        log.error("argument-refused %s", unknown)
        return 2
    try:
        _wait_for(_master_problem, "master")
    except KeyboardInterrupt:
        return 0
    rospy.init_node("mesh_bridge")
    log_to_ros()
    stop = threading.Event()
    rospy.on_shutdown(stop.set)
    given = parameters(DEFAULT_SOCKET)
    try:
        options = load_configuration(given.config) if given.config else EMPTY
    except BridgeConfigurationError as error:
        for line in str(error).splitlines():
            log.error("configuration-refused %s", line)
        return 2
    if options.tf:
        log.warning("configuration-ignored tf: only the ROS 2 bridge gathers transforms")
    received = with_needed((*given.receive, *options.receive), ["bridge/*"])
    daemon = DaemonClient(given.socket, [*received, Receive(CONDITIONS_TOPIC)])
    own: list[str] = []

    def daemon_problem() -> str:
        try:
            own[:] = [daemon.node_name()]
        except MeshError as error:
            return "" if rospy.is_shutdown() else str(error)
        return ""

    _wait_for(daemon_problem, "daemon")
    if not own:
        return 0
    bridge = Ros1Bridge(daemon, given.hostname or own[0], given, options)
    bridge.start(stop)

    def serve() -> None:
        try:
            daemon.run(stop, bridge.on_daemon_up, bridge.on_frame)
        finally:
            stop.set()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    bridge.run(stop)
    thread.join(5.0)
    # Not ROS but an unexpected exception, already logged, stopped the bridge: roslaunch restarts it.
    return 0 if rospy.is_shutdown() else 1


def _master_problem() -> str:
    """Why there is no master to connect to; "" if there is one."""
    if rosgraph.is_master_online():
        return ""
    return "no answer at ROS_MASTER_URI={}".format(rosgraph.get_master_uri())


def _wait_for(problem: Callable[[], str], what: str) -> None:
    """Polls once a second until there is no problem; logs once that it waits, and why."""
    logged = False
    while True:
        text = problem()
        if not text:
            return
        if not logged:
            log.info("waiting-for what=%s %s", what, text)
            logged = True
        time.sleep(1.0)
