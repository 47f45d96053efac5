"""A bridge's connection to the daemon, on a thread of its own; it survives restarts of the daemon.

`run` connects, subscribes, calls `on_up`, passes every frame to `on_frame`, and reconnects when the daemon goes away.
`publish` may be called from any thread; `request` uses a second connection, so that no reply waits behind messages.

Refused messages are counted and logged once per LOG_INTERVAL_S: thirty images a second must not become thirty lines.
"""

from __future__ import annotations

import logging
import threading
import time
from typing import Any, Callable, Mapping, Sequence

from udp_mesh.bridges.receiving import EVERYTHING, Receive
from udp_mesh.bridges.types import MeshTopic
from udp_mesh.client.mesh_client import Frame, Header, MeshClient, MeshError

log = logging.getLogger(__name__)

CONDITIONS_TOPIC = "~mesh/conditions"
READ_TIMEOUT_S = 0.5
"""Timeout of a read, after which the stop flag is checked."""
RECONNECT_S = 1.0
"""Delay between attempts to connect: a daemon's restart takes about that long."""
LOG_INTERVAL_S = 10.0
"""Interval between log lines about refused messages."""


class DaemonClient:
    """The daemon, as seen by a bridge."""

    def __init__(self, path: str, received: Sequence[Receive] = EVERYTHING) -> None:
        self._path = path
        self._received = list(received)
        self._client: MeshClient | None = None
        self._commands: MeshClient | None = None
        self._command_lock = threading.Lock()
        self.refused = 0
        """Messages that were not accepted: no daemon, or the daemon refused them."""
        self._logged_at: float | None = None
        self._unlogged = 0

    def run(self, stop: threading.Event, on_up: Callable[[], None], on_frame: Callable[[Frame], None]) -> None:
        """Runs until `stop` is set. Calls `on_up` after every connect, and `on_frame`, on this thread."""
        unreachable = False
        while not stop.is_set():
            try:
                with MeshClient(self._path) as client:
                    for each in self._received:
                        client.subscribe(each.pattern, rate_hz=each.rate_hz, max_age_s=each.max_age_s)
                    client.request("events")
                    self._client = client
                    log.info("daemon-connected socket=%s", self._path)
                    unreachable = False
                    on_up()
                    while not stop.is_set():
                        frame = client.next_frame(READ_TIMEOUT_S)
                        if frame is not None:
                            self._on_frame(frame, on_frame)
            except MeshError as error:
                if not unreachable:
                    log.warning("daemon-unreachable %s", error)
                    unreachable = True
            finally:
                self._client = None
            stop.wait(RECONNECT_S)
        self._close_commands()

    def _on_frame(self, frame: Frame, on_frame: Callable[[Frame], None]) -> None:
        header = frame[0]
        if header.get("event") == "rejected":
            self._count_refused("{}: {}".format(header.get("code"), header.get("error")))
        elif header.get("event") == "dropped":
            log.warning("messages-lost count=%s the bridge reads too slowly", header.get("messages"))
        else:
            on_frame(frame)

    def _count_refused(self, reason: str) -> None:
        self.refused += 1
        self._unlogged += 1
        now = time.monotonic()
        if self._logged_at is None or now - self._logged_at >= LOG_INTERVAL_S:
            self._logged_at = now
            log.warning("messages-refused count=%d %s", self._unlogged, reason)
            self._unlogged = 0

    def publish(self, topic: str, payload: bytes, peer: str | None, type_text: str, *, notify: bool = False) -> bool:
        """Publishes a message; False if there is no daemon now. A refusal by the daemon is logged. With `notify`, an
        event `outcome` follows if the topic is reliable."""
        client = self._client
        if client is None:
            self._count_refused("{}: the daemon is not connected".format(topic))
            return False
        try:
            client.publish(topic, payload, to=peer, type=type_text, notify=notify, wait=False)
            return True
        except MeshError as error:
            self._count_refused("{}: {}".format(topic, error))
            return False

    def request(self, op: str, **fields: Any) -> Header:
        """A reply's header. Raises MeshError."""
        with self._command_lock:
            if self._commands is None:
                self._commands = MeshClient(self._path)
            try:
                return self._commands.request(op, **fields)
            except MeshError as error:
                if error.code in ("unreachable", "timeout", "bad-frame"):
                    self._commands.close()
                    self._commands = None
                raise

    def _close_commands(self) -> None:
        with self._command_lock:
            if self._commands is not None:
                self._commands.close()
                self._commands = None

    # Requests

    def ensure_topics(self, wanted: Mapping[str, Mapping[str, object]]) -> dict[str, MeshTopic]:
        """Declares topics unknown to the daemon; returns all declared topics.

        The daemon's configuration takes precedence: topics listed there are not changed. Raises MeshError.
        """
        found = self.topics()
        for topic, values in wanted.items():
            if topic not in found:
                self.request("set-topic", topic=topic, values=dict(values))
                found[topic] = MeshTopic()
        return found

    def topics(self) -> dict[str, MeshTopic]:
        """Declared topics. Raises MeshError."""
        rows = self.request("topics")["topics"]
        return {
            row["name"]: MeshTopic(
                tuple(row.get("destinations", ())),
                row.get("log") is not None,
                bool(row["reliable"]),
                row["keep_last"],
            )
            for row in rows
            if row["configured"]
        }

    def accepts_undeclared(self) -> bool:
        """Whether the daemon accepts undeclared topics. Raises MeshError."""
        return self.request("topics")["undeclared"] is not None

    def peers(self) -> dict[str, bool]:
        """The daemon's peers, and whether each is online. Raises MeshError."""
        return {row["name"]: bool(row["online"]) for row in self.request("peers")["peers"]}

    def node_name(self) -> str:
        """The daemon's node name. Raises MeshError."""
        return str(self.request("status")["conditions"]["name"])
