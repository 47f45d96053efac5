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
from udp_mesh.bridges.relay import PROTOCOL_TOPICS, Effect, Note, Relay, ToMesh, ToRos
from udp_mesh.bridges.types import TypeKey
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
    ) -> None:
        """`to_ros` must not block; `wanted` are additional topics to declare, with their settings."""
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
        """Handles a message from a ROS node."""
        with self._lock:
            effects = self._relay.from_ros(route, publisher, key, definition, latched, payload)
        self._run(effects)

    def tick(self, now: float) -> None:
        """Handles what is due at `now` (monotonic seconds)."""
        with self._lock:
            effects = self._relay.tick(now)
        self._run(effects)

    def refresh_topics(self) -> dict[str, tuple[str, ...]]:
        """Declares the wanted topics; returns the daemon's topics with their destinations. Raises MeshError."""
        topics = self._daemon.ensure_topics(self._wanted)
        with self._lock:
            self._relay.set_destinations(topics)
        return topics

    def _run(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, ToMesh):
                self._daemon.publish(effect.topic, effect.payload, effect.peer, effect.type)
            elif isinstance(effect, ToRos):
                self._to_ros(effect)
            elif isinstance(effect, Note):
                log.warning("%s", effect.text)
