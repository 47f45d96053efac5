"""A Meshtastic radio that carries the frames of a thin link, through Meshtastic's own client library.

The library blocks and has threads of its own: a thread here connects and sends, the library's threads put what arrives
into a bounded queue, and an event descriptor wakes the daemon's loop. Frames are payloads of the port number
PRIVATE_APP (256), to all.
"""

from __future__ import annotations

import errno
import os
import queue
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

MESHTASTIC = "meshtastic"
MAX_PAYLOAD_BYTES = 233
"""Largest payload of a `Data` message (mesh.proto, DATA_PAYLOAD_LEN)."""
MAX_HOP_LIMIT = 3
CONNECT_TIMEOUT_S = 30
"""For the radio's configuration, which it sends first."""
MAX_WAITING_FRAMES = 16
"""Frames that the radio does not take are kept up to this; more are lost."""
MAX_ARRIVED_FRAMES = 256


@dataclass(frozen=True, slots=True)
class MeshtasticPortConfig:
    """One radio: the thin link's name, the serial device, and how often other radios repeat a frame."""

    link: str
    device: str
    hop_limit: int = 0


class MeshtasticPort:
    """A radio that is being connected, or is. Same use as `SerialPort`; errors appear at `receive`."""

    def __init__(self, config: MeshtasticPortConfig) -> None:
        """Raises OSError if the device or the library is missing."""
        if find_spec("meshtastic") is None:
            raise OSError(errno.ENOPKG, "the library is missing; run: pip install meshtastic", MESHTASTIC)
        os.stat(config.device)
        self.config = config
        self.ready = False
        self.refusal: str | None = None
        self.frames_lost = 0
        self._failure: str | None = None
        self._closing = False
        self._interface: Any = None
        self._to_send: queue.Queue[bytes | None] = queue.Queue(MAX_WAITING_FRAMES)
        self._arrived: deque[bytes] = deque(maxlen=MAX_ARRIVED_FRAMES)
        # The lock: no thread writes to its number once it is closed, and perhaps another file's.
        self._descriptor = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, daemon=True, name=f"meshtastic {config.link}")
        self._thread.start()

    # In the loop

    def fileno(self) -> int:
        return self._descriptor

    def receive(self) -> list[bytes]:
        """The frames that have arrived. Raises OSError if the radio is gone or did not answer."""
        with suppress(BlockingIOError):
            os.eventfd_read(self._descriptor)
        if self._failure is not None:
            raise OSError(errno.EIO, self._failure, self.config.device)
        frames = []
        while self._arrived:
            frames.append(self._arrived.popleft())
        return frames

    def send(self, frame: bytes) -> None:
        """Send a frame, or lose it if too much waits."""
        try:
            self._to_send.put_nowait(bytes(frame))
        except queue.Full:
            self.frames_lost += 1

    @property
    def has_waiting(self) -> bool:
        """The thread waits instead of the loop."""
        return False

    def write_more(self) -> None:
        """Nothing to do, see `has_waiting`."""

    def close(self) -> None:
        """Ends the connection in the background: the library takes a while."""
        with self._lock:
            self._closing = True
            os.close(self._descriptor)
        try:
            while True:
                self._to_send.get_nowait()
        except queue.Empty:
            self._to_send.put(None)

    # In the thread, and in those of the library

    def _run(self) -> None:
        try:
            self._connect_and_send()
        # The library raises whatever its parts raise, and calls `sys.exit` for some mistakes.
        except (Exception, SystemExit) as error:  # noqa: BLE001
            self._fail(f"{type(error).__name__}: {error}")

    def _connect_and_send(self) -> None:
        from meshtastic.protobuf.portnums_pb2 import PortNum
        from meshtastic.serial_interface import SerialInterface
        from pubsub import pub

        # The library's topics are those of all radios of the process, and hold listeners weakly.
        listeners: dict[Callable[..., None], str] = {
            self._on_packet: "meshtastic.receive.data.PRIVATE_APP",
            self._on_routing: "meshtastic.receive.routing",
            self._on_lost: "meshtastic.connection.lost",
        }
        for listener, topic in listeners.items():
            pub.subscribe(listener, topic)
        try:
            self._interface = SerialInterface(self.config.device, noNodes=True, timeout=CONNECT_TIMEOUT_S)
            self.ready = True
            self._wake()
            while (frame := self._to_send.get()) is not None:
                self.refusal = None
                self._interface.sendData(
                    frame, portNum=PortNum.PRIVATE_APP, wantAck=False, hopLimit=self.config.hop_limit
                )
        finally:
            for listener, topic in listeners.items():
                pub.unsubscribe(listener, topic)
            if self._interface is not None:
                self._interface.close()

    def _fail(self, reason: str) -> None:
        self._failure = self._failure or reason
        self._wake()

    def _wake(self) -> None:
        with self._lock:
            if not self._closing:
                os.eventfd_write(self._descriptor, 1)

    def _on_packet(self, packet: dict[str, Any], interface: Any) -> None:
        payload = packet.get("decoded", {}).get("payload")
        if interface is self._interface and isinstance(payload, bytes) and payload:
            self._arrived.append(payload)
            self._wake()

    def _on_routing(self, packet: dict[str, Any], interface: Any) -> None:
        """The radio's own answer to a frame: an error, such as that its duty cycle is used up."""
        reason = packet.get("decoded", {}).get("routing", {}).get("errorReason", "NONE")
        if interface is self._interface and reason != "NONE":
            self.refusal = f"it answers {reason}"
            self._wake()

    def _on_lost(self, interface: Any) -> None:
        if interface is self._interface:
            self._fail("the radio is gone")
