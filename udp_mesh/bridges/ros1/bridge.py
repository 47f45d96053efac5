"""The ROS 1 bridge: the daemon's connection and the ROS graph, joined by the relay.

Three kinds of threads meet here: rospy's (one per connection), the port's, and `main`'s, which every TICK_S looks after
what changed: topics, peers, the master. The relay is entered under one lock; its effects run outside of it. Of these
only `main`'s waits for the master, so that what flows goes on flowing while there is none.
"""

from __future__ import annotations

import json
import logging
import os
import threading
import time
from typing import Callable

import rosgraph
import rospy

from udp_mesh.bridges.exchange import TOPIC_SETTINGS
from udp_mesh.bridges.names import (
    Route,
    outbound_name,
    parse_topic_list,
    ros_word,
    routes,
    undeclared_route,
)
from udp_mesh.bridges.port import CONDITIONS_TOPIC, MeshPort
from udp_mesh.bridges.relay import Effect, Note, Relay, ToMesh, ToRos
from udp_mesh.bridges.ros1.graph import MASTER_ERRORS, Graph, Parameters, log_to_ros, parameters
from udp_mesh.bridges.types import TypeKey
from udp_mesh.client.mesh_client import DEFAULT_SOCKET, Frame, MeshError, as_message

log = logging.getLogger(__name__)

EXCHANGE_TOPIC = "bridge/ros1"
ANY = "any"
"""The fielded system's topic for messages of any type, at priority 1."""
TICK_S = 0.1
LOOK_S = 1.0
"""Between two looks at the daemon's topics, its peers and the master."""


class Bridge:
    """The running bridge."""

    def __init__(self, port: MeshPort, own: str, given: Parameters) -> None:
        self._port = port
        self._own = own
        self._relay = Relay(own, EXCHANGE_TOPIC, ros_version=1, nonce=os.urandom(16))
        self._lock = threading.Lock()
        self._look_soon = threading.Event()
        self._hosts = {str(host) for host in given.host_list}
        listed, problems = parse_topic_list(given.topic_list)
        for problem in problems:
            log.error("parameter-refused %s", problem)
        self._wanted = {topic.topic: {"priority": topic.priority} for topic in listed}
        self._wanted.setdefault(ANY, {"priority": 1})
        self._master_gone = False
        self._graph = Graph(self._from_ros, "/{}/".format(ros_word(own)), self._set_window)

    def start(self, stop: threading.Event) -> None:
        """Begins to publish; until `stop`."""
        self._graph.start(stop)

    def _run(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, ToMesh):
                self._port.publish(effect.topic, effect.payload, effect.peer, effect.type)
            elif isinstance(effect, ToRos):
                self._graph.publish(effect)
            elif isinstance(effect, Note):
                log.warning("%s", effect.text)

    # What happens

    def _from_ros(
        self, route: Route, publisher: str, key: TypeKey, definition: str, latched: bool, payload: bytes
    ) -> None:
        with self._lock:
            effects = self._relay.from_ros(route, publisher, key, definition, latched, payload)
        self._run(effects)

    def daemon_up(self) -> None:
        """The port calls this after each connect. Raises MeshError."""
        self._learn()
        online = [peer for peer, is_online in self._port.peers().items() if is_online]
        with self._lock:
            effects = self._relay.started(online)
        self._run(effects)
        self._look_soon.set()

    def from_daemon(self, frame: Frame) -> None:
        """The port calls this for each frame."""
        message, header = as_message(frame), frame[0]
        event = header.get("event")
        effects: list[Effect] = []
        with self._lock:
            if message is not None:
                effects = self._relay.from_mesh(
                    message.source, message.topic, message.type, message.payload, time.monotonic()
                )
            elif event == "peer-online":
                effects = self._relay.peer_online(str(header["peer"]))
        self._run(effects)
        if event == "conditions":
            self._graph.publish_conditions(header["conditions"], json.dumps(header["conditions"], sort_keys=True))
        elif event == "peer-online":
            self._look_soon.set()

    def _set_window(self, packets: int) -> None:
        try:
            self._port.request("set-window", window=packets or "adaptive")
        except MeshError as error:
            log.warning("window-unchanged packets=%d %s", packets, error)

    # What is looked after, by one thread

    def run(self, stop: threading.Event) -> None:
        """Until `stop`: every TICK_S, and every LOOK_S or when something came, a look around."""
        looked_at = 0.0
        while not stop.wait(TICK_S):
            now = time.monotonic()
            with self._lock:
                effects = self._relay.tick(now)
            self._run(effects)
            if self._look_soon.is_set() or now - looked_at >= LOOK_S:
                self._look_soon.clear()
                looked_at = now
                self._look()

    def _look(self) -> None:
        """Topics may be added, peers may come, the master may go: listen on what is there now."""
        try:
            self._graph.renew()
            self._master_gone = False
        except MASTER_ERRORS as error:
            if not self._master_gone:
                log.warning("master-unreachable %s", error)
            self._master_gone = True
            return
        try:
            topics, undeclared = self._learn(), self._port.takes_undeclared()
            peers = {*self._port.peers(), *self._hosts}
        except MeshError as error:
            log.debug("daemon-unreachable %s", error)
            return
        declared = [topic for topic in topics if not topic.startswith("bridge/")]
        table = routes(self._own, declared, peers)
        if undeclared:
            self._add_undeclared(table, peers)
        self._graph.listen(table)

    def _learn(self) -> dict[str, tuple[str, ...]]:
        """The daemon's topics, ours among them. Raises MeshError."""
        topics = self._port.ensure_topics({EXCHANGE_TOPIC: TOPIC_SETTINGS, **self._wanted})
        with self._lock:
            self._relay.topics_are(topics)
        return topics

    def _add_undeclared(self, table: dict[str, Route], peers: set[str]) -> None:
        try:
            published = self._graph.published()
        except MASTER_ERRORS as error:
            log.debug("master-unreachable %s", error)
            return
        for name in published:
            route = undeclared_route(self._own, name, peers)
            if route is not None and name not in table and outbound_name(self._own, route) == name:
                table[name] = route


def main() -> int:
    """Runs until ROS or a signal ends it. Waits for a master and for the daemon."""
    logging.basicConfig(level=logging.INFO, format="%(levelname)s %(name)s %(message)s")
    try:
        _wait_for(lambda: bool(rosgraph.is_master_online()), "master")
    except KeyboardInterrupt:
        return 0
    rospy.init_node("mesh_bridge")
    log_to_ros()
    stop = threading.Event()
    rospy.on_shutdown(stop.set)
    given = parameters(DEFAULT_SOCKET)
    port = MeshPort(given.socket, ["*", CONDITIONS_TOPIC])
    own: list[str] = []

    def named() -> bool:
        try:
            own[:] = [port.own_name()]
        except MeshError:
            return bool(rospy.is_shutdown())
        return True

    _wait_for(named, "daemon")
    if not own:
        return 0
    bridge = Bridge(port, given.hostname or own[0], given)
    bridge.start(stop)

    def serve() -> None:
        try:
            port.run(stop, bridge.daemon_up, bridge.from_daemon)
        finally:
            stop.set()

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    bridge.run(stop)
    thread.join(5.0)
    # Where ROS did not end us, a thread of ours did by a mistake, and said which: roslaunch starts us anew.
    return 0 if rospy.is_shutdown() else 1


def _wait_for(condition: Callable[[], bool], what: str) -> None:
    """Asks once a second until it is so, and says once that it waits."""
    told = False
    while not condition():
        if not told:
            log.info("waiting-for what=%s", what)
            told = True
        time.sleep(1.0)
