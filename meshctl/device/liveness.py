"""Detect a dead connection while waiting for it: keepalives, and a watchdog.

TCP detects a broken link only after a minute or, through another node's tunnel, never. So while a command runs the
server is sent keepalives (`keepalives`; every SSH server replies to an unknown global request, RFC 4254 section 4).
`ActivityStream` records when data arrived. `Watchdog` closes the connection when none has for too long, or when the
whole wait has taken too long.
"""

from __future__ import annotations

import heapq
import itertools
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
# Watchdogs whose block has ended are forgotten when they are due, or when more than this are kept.
MAX_ENDED_WATCHDOGS = 64
# More than one SSH packet (RFC 4253 section 6.1).
READ_BYTES = 64 << 10
# A process that was suspended reads the data that arrived meanwhile within this time.
MAX_OWN_PAUSE_S = 1.0


class ActivityStream:
    """A stream that records when it last received data: `last_received_s`, monotonic. `count` gets the number of bytes
    that are sent or received.

    paramiko's reading thread wakes ten times a second to see whether its connection was closed or needs a keepalive,
    which costs a fleet's hundreds of idle connections a quarter of a processor. Here it wakes every `poll_s`, and
    `close` wakes it. Of what has arrived it takes all at once: paramiko reads a packet in two to four pieces, and each
    system call gives up the interpreter's lock, for which hundreds of threads compete.
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
        self._unread = b""
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
        data = self._unread
        if not data:
            data = self._stream.recv(max(count, READ_BYTES))
            if data:
                self.last_received_s = time.monotonic()
                self._count(len(data))
        self._unread = data[count:]
        return data[:count]

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
    for `silence_s` (`silent`). All of them share one thread (`_WatchdogThread`)."""

    def __init__(
        self,
        transport: paramiko.Transport,
        seconds: float,
        *,
        activity: ActivityStream | None = None,
        silence_s: float = 0.0,
    ) -> None:
        self.timed_out = self.silent = False
        self.is_over = False
        self._transport = transport
        self._seconds = seconds
        self._activity = activity
        self._silence_s = silence_s
        self._began_s = 0.0

    def check(self, now_s: float) -> float | None:
        """When to check again; None if the block has taken too long. Called by the patrol until `is_over`."""
        left_s = self._began_s + self._seconds - now_s
        if left_s <= 0:
            self.timed_out = True
            return None
        if self._activity is not None:
            # silence before this wait does not count
            patience_s = max(self._activity.last_received_s, self._began_s) + self._silence_s - now_s
            if patience_s <= -MAX_OWN_PAUSE_S:
                self.silent = True
                return None
            # check once more past the limit: our process may have been suspended, with the reply unread
            left_s = min(left_s, patience_s if patience_s > 0 else MAX_OWN_PAUSE_S)
        return now_s + left_s

    def close_transport(self) -> None:
        """In a thread of its own: closing waits for the transport's thread, and other blocks have deadlines, too."""
        try:
            threading.Thread(target=self._transport.close, name="close", daemon=True).start()
        except RuntimeError:
            # no more threads can be started
            self._transport.close()

    def __enter__(self) -> Watchdog:
        self._began_s = time.monotonic()
        _WATCHDOG_THREAD.add(self, self._began_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        _WATCHDOG_THREAD.end(self)


class _WatchdogThread:
    """Checks every watchdog when it is due, in one daemon thread that starts with the first watchdog. With a thread for
    each phase of each connection, an observation of 200 nodes would start 800. Thread-safe."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._due: list[tuple[float, int, Watchdog]] = []
        self._number = itertools.count()
        self._running = 0
        self._is_started = False

    def add(self, watchdog: Watchdog, now_s: float) -> None:
        with self._changed:
            self._running += 1
            self._put(watchdog, now_s)
            if not self._is_started:
                self._is_started = True
                threading.Thread(target=self._run, name="watchdogs", daemon=True).start()

    def end(self, watchdog: Watchdog) -> None:
        with self._changed:
            watchdog.is_over = True
            self._running -= 1
            if len(self._due) > max(2 * self._running, MAX_ENDED_WATCHDOGS):
                self._due = [entry for entry in self._due if not entry[2].is_over]
                heapq.heapify(self._due)

    def _put(self, watchdog: Watchdog, now_s: float) -> None:
        due_s = watchdog.check(now_s)
        if due_s is None:
            watchdog.close_transport()
            return
        heapq.heappush(self._due, (due_s, next(self._number), watchdog))
        if self._due[0][2] is watchdog:
            self._changed.notify()

    def _run(self) -> None:
        with self._changed:
            while True:
                now_s = time.monotonic()
                while self._due and self._due[0][0] <= now_s:
                    watchdog = heapq.heappop(self._due)[2]
                    if not watchdog.is_over:
                        self._put(watchdog, now_s)
                self._changed.wait(self._due[0][0] - now_s if self._due else None)


_WATCHDOG_THREAD = _WatchdogThread()
