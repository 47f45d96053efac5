"""The part between daemon and relay that all ROS bridges share: passes frames and messages in, executes effects.

Called by several threads: the daemon client's and the middleware's. The relay is protected by one lock; its effects are
executed outside of it.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import Callable, Mapping

from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.names import Route
from udp_mesh.bridges.protocol import TOPIC_SETTINGS
from udp_mesh.bridges.reduction import Reducer, ReductionError
from udp_mesh.bridges.relay import PROTOCOL_TOPICS, Effect, Note, Relay, ToMesh, ToRos
from udp_mesh.bridges.types import MeshTopic, TypeKey
from udp_mesh.client.mesh_client import Frame, as_message

log = logging.getLogger(__name__)


class BridgeRuntime:
    """Joins the daemon behind `daemon` and the ROS graph behind `to_ros` through the relay."""

    def __init__(
        self,
        daemon: DaemonClient,
        relay: Relay,
        to_ros: Callable[[ToRos], None],
        wanted: Mapping[str, Mapping[str, object]] | None = None,
        reducer: Reducer | None = None,
    ) -> None:
        """`to_ros` must not block; `wanted` are additional topics to declare, with their settings. `reducer`: None
        sends every message as it is published."""
        self._reducer = reducer or Reducer({}, 1)
        self._unreduced: set[str] = set()
        self._daemon = daemon
        self._relay = relay
        self._to_ros = to_ros
        self._wanted = {**dict.fromkeys(PROTOCOL_TOPICS.values(), TOPIC_SETTINGS), **(wanted or {})}
        self._lock = threading.Lock()

    def on_daemon_up(self) -> None:
        """Called by the daemon client after each connect. Raises MeshError."""
        self.refresh_topics()
        online = [peer for peer, is_online in self._daemon.peers().items() if is_online]
        with self._lock:
            effects = self._relay.on_daemon_up(online)
        self._run(effects)

    def on_frame(self, frame: Frame) -> None:
        """Called by the daemon client for each frame."""
        message, header = as_message(frame), frame[0]
        if header.get("event") == "outcome":
            topic, peer, outcome = (str(header[name]) for name in ("topic", "peer", "outcome"))
            self._reducer.on_outcome(topic, peer, outcome, header.get("latency_s"), time.monotonic())
            return
        effects: list[Effect] = []
        with self._lock:
            if message is not None:
                now = time.monotonic()
                effects = self._relay.from_mesh(message.source, message.topic, message.type, message.payload, now)
            elif header.get("event") == "peer-online":
                effects = self._relay.on_peer_online(str(header["peer"]))
        self._run(effects)

    def from_ros(
        self, route: Route, publisher: str, key: TypeKey, definition: str, latched: bool, payload: bytes
    ) -> None:
        """Handles a message from a ROS node. One that cannot be reduced is not sent: it may be larger than the link
        can carry."""
        try:
            reduced = self._reducer.reduce(route, key, definition, payload, time.monotonic(), latched=latched)
        except (ReductionError, ModuleNotFoundError) as error:
            self._note_unreduced(route.topic, str(error))
            return
        if reduced is None:
            return
        with self._lock:
            effects = self._relay.from_ros(route, publisher, *reduced[:2], latched, reduced.payload)
        self._run(effects)

    def _note_unreduced(self, topic: str, reason: str) -> None:
        """Once per topic, since a camera would repeat it thirty times a second."""
        if topic not in self._unreduced:
            self._unreduced.add(topic)
            log.warning("message-not-sent topic=%s %s", topic, reason)

    def tick(self, now: float) -> None:
        """Handles what is due at `now` (monotonic seconds)."""
        with self._lock:
            effects = self._relay.tick(now)
        self._run(effects)

    def refresh_topics(self, more: Mapping[str, Mapping[str, object]] | None = None) -> dict[str, MeshTopic]:
        """Declares the wanted topics and `more`; returns the daemon's topics. Raises MeshError."""
        topics = self._daemon.ensure_topics({**self._wanted, **(more or {})})
        with self._lock:
            self._relay.set_topics(topics)
        return topics

    def _run(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, ToMesh):
                notify = self._reducer.adapts(effect.topic)
                self._daemon.publish(effect.topic, effect.payload, effect.peer, effect.type, notify=notify)
            elif isinstance(effect, ToRos):
                self._to_ros(effect)
            elif isinstance(effect, Note):
                log.warning("%s", effect.text)
