"""Detect a dead connection while waiting for it: keepalives, and a watchdog.

TCP detects a broken link only after a minute or, through another node's tunnel, never. So while a command runs the
server is sent keepalives (`keepalives`; every SSH server replies to an unknown global request, RFC 4254 section 4).
`ActivityStream` records when data arrived. `Watchdog` closes the connection when none has for too long, or when the
whole wait has taken too long.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any

import paramiko
from paramiko.common import cMSG_GLOBAL_REQUEST
from paramiko.message import Message

# The request name of OpenSSH (ServerAliveInterval); dropbear replies with a failure, which is enough.
_REQUEST = "keepalive@openssh.com"
# A process that was suspended reads the data that arrived meanwhile within this time.
MAX_OWN_PAUSE_S = 1.0


class ActivityStream:
    """A stream that records when it last received data: `last_received_s`, monotonic. `count` gets the number of bytes
    that are sent or received.

    paramiko's reading thread wakes ten times a second to see whether its connection was closed or needs a keepalive,
    which costs a fleet's hundreds of idle connections a quarter of a processor. Here it wakes every `poll_s`, and
    `close` wakes it.
    """

    def __init__(
        self,
        stream: socket.socket | paramiko.Channel,
        *,
        poll_s: float = 1.0,
        count: Callable[[int], None] = lambda size: None,
    ) -> None:
        self._stream = stream
        self._count = count
        self._poll_s = poll_s
        self.last_received_s = time.monotonic()

    def settimeout(self, timeout_s: float) -> None:
        self._stream.settimeout(max(timeout_s, self._poll_s))

    def close(self) -> None:
        if isinstance(self._stream, socket.socket):
            # closing a descriptor does not wake the thread that waits for it
            with suppress(OSError):
                self._stream.shutdown(socket.SHUT_RDWR)
        self._stream.close()

    def recv(self, count: int) -> bytes:
        data = self._stream.recv(count)
        if data:
            self.last_received_s = time.monotonic()
            self._count(len(data))
        return data

    def send(self, data: bytes) -> int:
        sent = self._stream.send(data)
        self._count(sent)
        return sent

    def __getattr__(self, name: str) -> Any:
        # paramiko also reads private attributes of its stream
        return getattr(self._stream, name)


@contextmanager
def keepalives(transport: paramiko.Transport, every_s: float, idle_s: float) -> Iterator[None]:
    """Within this block, send a keepalive that wants a reply whenever the connection is idle for `every_s`; afterwards
    one that wants none, every `idle_s`. The transport's thread sends them."""

    def send_request() -> None:
        request = Message()
        request.add_byte(cMSG_GLOBAL_REQUEST)
        request.add_string(_REQUEST)
        request.add_boolean(True)
        # paramiko's global_request would wait for the reply in the thread that has to read it
        transport._send_user_message(request)  # type: ignore[attr-defined]

    transport.packetizer.set_keepalive(every_s, send_request)
    try:
        yield
    finally:
        # a closed transport needs no keepalives
        if transport.is_active():
            transport.set_keepalive(int(idle_s))


class Watchdog:
    """Closes `transport` when this block takes longer than `seconds` (`timed_out`), or when `activity` shows no data
    for `silence_s` (`silent`)."""

    def __init__(
        self,
        transport: paramiko.Transport,
        seconds: float,
        *,
        activity: ActivityStream | None = None,
        silence_s: float = 0.0,
    ) -> None:
        self.timed_out = self.silent = False
        self._transport = transport
        self._seconds = seconds
        self._activity = activity
        self._silence_s = silence_s
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self) -> None:
        began_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            left_s = began_s + self._seconds - now_s
            if left_s <= 0:
                self.timed_out = True
                break
            if self._activity is not None:
                # silence before this wait does not count
                patience_s = max(self._activity.last_received_s, began_s) + self._silence_s - now_s
                if patience_s <= -MAX_OWN_PAUSE_S:
                    self.silent = True
                    break
                # check once more past the limit: our process may have been suspended, with the reply unread
                left_s = min(left_s, patience_s if patience_s > 0 else MAX_OWN_PAUSE_S)
            if self._over.wait(left_s):
                return
        self._transport.close()

    def __enter__(self) -> Watchdog:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._over.set()
