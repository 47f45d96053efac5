"""Where calls of a bridge meet the daemon: what the mesh says goes to `Calls`, whichever ROS is on the other side.

The daemon client's thread calls `on_daemon_up` and `on_frame`; `_take` brings their work to where the bridge's effects
are executed.
"""

from __future__ import annotations

import logging
import time
from typing import Callable, Iterable, List

from udp_mesh.bridges.call_messages import SETTINGS
from udp_mesh.bridges.calls import CallEffect, Calls
from udp_mesh.bridges.daemon_client import DaemonClient
from udp_mesh.bridges.once_log import OnceLog
from udp_mesh.client.mesh_client import Frame, as_message

log = logging.getLogger(__name__)

PATIENCE_S = 20.0
"""For servers that start later than the bridge, before it reports that there is none."""


class MeshCalls:
    """The half of a bridge's services that does not know ROS; `topic` is theirs on the mesh, `run` as in `Calls`."""

    def __init__(self, daemon: DaemonClient, topic: str, run: str) -> None:
        self._daemon, self._topic = daemon, topic
        self._calls = Calls(run)
        self._once = OnceLog(log)
        self._started_at = time.monotonic()

    def _take(self, work: Callable[[], List[CallEffect]]) -> None:
        """Executes the effects of this work, now or on another thread."""
        raise NotImplementedError

    def on_daemon_up(self) -> None:
        """Raises MeshError."""
        self._daemon.ensure_topics({self._topic: SETTINGS})
        online = [peer for peer, is_online in self._daemon.peers().items() if is_online]
        self._take(lambda: self._calls.on_daemon_up(online))

    def on_frame(self, frame: Frame) -> None:
        message, header = as_message(frame), frame[0]
        now = time.monotonic()
        if message is not None and message.topic == self._topic:
            source, payload = message.source, message.payload
            self._take(lambda: self._calls.from_mesh(source, payload))
        elif header.get("event") == "peer-online":
            self._take(lambda: self._calls.on_peer_online(str(header["peer"])))
        elif header.get("event") == "peer-offline":
            self._take(lambda: self._calls.on_peer_offline(str(header["peer"]), now))

    def note_missing(self, kind: str, names: Iterable[str]) -> None:
        """Reports services or actions of the bridge's file that have no server."""
        if time.monotonic() - self._started_at >= PATIENCE_S:
            for name in names:
                self._warn_once("not-offered {}={} has no server on this robot".format(kind, name))

    def _warn_once(self, text: str) -> None:
        self._once.warn([text])
