"""Whether the other end of a connection is still there while we wait for it: ask it now and then, and listen.

A link that breaks says nothing, and TCP notices only after a minute or, through another node's tunnel, never. So while
a command runs its server is asked for a sign (`asking`; every SSH server answers a request that it does not know, RFC
4254 section 4), `Heard` remembers when anything came, and `Watch` closes the connection when nothing has for too long,
or when the whole wait has taken too long.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any

import paramiko
from paramiko.common import cMSG_GLOBAL_REQUEST
from paramiko.message import Message

# The name OpenSSH asks under (ServerAliveInterval); dropbear refuses every such request, which is a sign, too.
_REQUEST = "keepalive@openssh.com"
# A process that was stopped, or had no processor for a while, reads what came meanwhile within this time.
MAX_OWN_PAUSE_S = 1.0


class ActivityStream:
    """A stream that remembers, in `at_s` of the monotonic clock, when it last gave anything."""

    def __init__(self, stream: socket.socket | paramiko.Channel) -> None:
        self._stream = stream
        self.last_received_s = time.monotonic()

    def recv(self, count: int) -> bytes:
        data = self._stream.recv(count)
        if data:
            self.last_received_s = time.monotonic()
        return data

    def __getattr__(self, name: str) -> Any:
        # all else is the stream's own: paramiko also looks at attributes that are none of the public ones
        return getattr(self._stream, name)


@contextmanager
def keepalives(transport: paramiko.Transport, every_s: float, idle_s: float) -> Iterator[None]:
    """Within this block the server is asked for a sign whenever nothing was read or written for `every_s`; afterwards
    it is sent a keepalive that wants no answer, every `idle_s`. The transport's own thread does it."""

    def send_request() -> None:
        request = Message()
        request.add_byte(cMSG_GLOBAL_REQUEST)
        request.add_string(_REQUEST)
        request.add_boolean(True)
        # paramiko's own global_request waits for the answer in the thread that would have to read it
        transport._send_user_message(request)  # type: ignore[attr-defined]

    transport.packetizer.set_keepalive(every_s, send_request)
    try:
        yield
    finally:
        # one that has been closed has nobody to keep alive
        if transport.is_active():
            transport.set_keepalive(int(idle_s))


class Watchdog:
    """Closes `transport` when `seconds` have passed (`passed`), or when `heard` has been silent for `silence_s`
    (`silent`) within this block."""

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
                # what was silent before we began to wait had nothing to say
                patience_s = max(self._activity.last_received_s, began_s) + self._silence_s - now_s
                if patience_s <= -MAX_OWN_PAUSE_S:
                    self.silent = True
                    break
                # past its time it gets one more look: it may be we who slept, and the answer lies there unread
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
