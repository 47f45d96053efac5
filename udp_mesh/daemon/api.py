"""The local API's transport: a Unix socket, frames in, frames out (docs/local-api.md).

A connection passes each request to the service and writes the replies. Data for a slow reader is bounded: beyond
`MAX_CLIENT_BACKLOG_BYTES`, messages for it are dropped and their number is reported once it reads again; beyond another
`MAX_REPLY_BACKLOG_BYTES`, its own requests wait. Other readers and the mesh never wait for it. A message for a client
that has read everything is never dropped, however large.
"""

from __future__ import annotations

import asyncio
import contextlib
import resource
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Protocol, cast

from udp_mesh.client.mesh_client import Frame, Header, encode_frame
from udp_mesh.daemon.framing import BadFrame, RequestReader
from udp_mesh.daemon.listener import Listener

MAX_CLIENT_BACKLOG_BYTES = 32 << 20
"""Bytes written to one client and not yet read by it: room for a few of the largest usual messages."""
MAX_TOTAL_BACKLOG_BYTES = 256 << 20
"""The same for all clients together; beyond it, a client that holds more than an equal share gets no more."""
MAX_PARTIAL_REQUEST_BYTES = 256 << 20
"""Bytes of incomplete requests of all clients together: several of the largest messages. Beyond it, the request of a
client that holds more than an equal share is refused."""
MAX_REPLY_BACKLOG_BYTES = 4 << 20
"""Bytes of replies on top of that, for a client that sends requests and never reads the replies."""
MAX_CLIENTS = 256
"""Concurrent connections: a program that leaks them must not exhaust the daemon's file descriptors."""
MAX_SPARE_CLIENTS = 8
"""Connections beyond that, for diagnosis only: each may send one of `SPARE_OPS` within `SPARE_TIMEOUT_S`. A further one
evicts the oldest."""
SPARE_OPS = ("status", "metrics")
SPARE_TIMEOUT_S = 2.0
PARTIAL_REQUEST_TIMEOUT_S = 30.0
"""A connection whose incomplete request makes no progress for this long is closed."""
RESERVED_DESCRIPTORS = 40
"""Descriptors the daemon itself needs whatever its limit: links, netlink, outbox, recording, configuration, metrics."""


_CREDENTIALS = struct.Struct("iII")


class RequestError(Exception):
    """A refused request; `code` is for programs, the text for people."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class RequestHandler(Protocol):
    """Handles requests."""

    def request(self, client: Client, header: Header, payload: bytes) -> None:
        """Replies now or later through `client`. Raises RequestError to refuse."""
        ...

    def client_read(self) -> None:
        """A client has read most of what waited for it."""
        ...

    def client_gone(self, client: Client) -> None: ...


class Client(asyncio.Protocol):
    """One connected client."""

    def __init__(self, server: LocalServer, *, spare: bool = False) -> None:
        self._server = server
        self.spare = spare
        """Connected beyond the limit; it may send one diagnostic request."""
        self.user: int | None = None
        """The client's user id; None if the kernel does not report it."""
        self._deadline: asyncio.TimerHandle | None = None
        self._received_bytes = self._received_before = 0
        """Bytes of the connection, and how many there were when the wait for the rest of a request began."""
        self._reader = RequestReader(server.max_payload_bytes)
        self._transport: asyncio.Transport | None = None
        self._dropped = 0
        self.written_bytes = 0
        """Bytes written to the connection so far."""
        self._read_bytes = 0

    # Called by the service

    def reply(self, request_id: object, payload: bytes = b"", **fields: object) -> None:
        """Replies to a request; a request without an id gets no reply."""
        if request_id is not None:
            self._write({"id": request_id, "ok": True, **fields}, payload)

    def refuse(self, request_id: object, code: str, text: str) -> None:
        """Refuses a request; for a request without an id, sends a `rejected` event."""
        if request_id is None:
            self._write({"event": "rejected", "code": code, "error": text})
        else:
            self._write({"id": request_id, "ok": False, "code": code, "error": text})

    def send_event(self, header: Header, payload: bytes = b"") -> None:
        """Sends an event; drops and counts it if the client does not read."""
        if self._transport is not None:
            self.send_encoded(encode_frame(header, payload))

    def send_encoded(self, frame: bytes) -> bool:
        """Like `send_event`, for a frame that is sent to several clients. False if it was dropped."""
        transport = self._transport
        if transport is None or transport.is_closing():
            return False
        waiting = self.backlog_bytes()
        if waiting and (waiting + len(frame) > MAX_CLIENT_BACKLOG_BYTES or self._server.exceeds_backlog_share(waiting)):
            self._dropped += 1
            self._server.dropped_for_slow_clients += 1
            return False
        if self._dropped:
            self._report_dropped()
        self.written_bytes += len(frame)
        transport.write(frame)
        return True

    def partial_request_bytes(self) -> int:
        """Bytes of the incomplete request."""
        return self._reader.buffered_bytes

    def backlog_bytes(self) -> int:
        """Bytes written and not yet read by the client."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    @property
    def read_bytes(self) -> int:
        """Bytes of the connection that the client's socket has taken, as far as was known before it was closed."""
        if self._transport is not None and not self._transport.is_closing():
            self._read_bytes = self.written_bytes - self._transport.get_write_buffer_size()
        return self._read_bytes

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()

    def _report_dropped(self) -> None:
        dropped, self._dropped = self._dropped, 0
        self._write({"event": "dropped", "messages": dropped})

    def _write(self, header: Header, payload: bytes = b"") -> None:
        # To a connection that broke, asyncio would log each write.
        if self._transport is not None and not self._transport.is_closing():
            frame = encode_frame(header, payload)
            self.written_bytes += len(frame)
            self._transport.write(frame)

    # Called by asyncio

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self.user = _peer_uid(transport.get_extra_info("socket"))
        self._server.on_connected(self)
        if self.spare:
            self._deadline = asyncio.get_running_loop().call_later(SPARE_TIMEOUT_S, self.reject)

    def reject(self) -> None:
        """Refuses this connection because the limit is reached."""
        self._server.spares.pop(self, None)
        self.refuse(None, "too-many-clients", self._server.too_many_clients_text())
        self.close()

    def data_received(self, data: bytes) -> None:
        self._received_bytes += len(data)
        for frame in self._reader.feed(data):
            if isinstance(frame, BadFrame):
                self.refuse(*frame)
            else:
                self._handle(frame)
        if self._server.exceeds_partial_request_share(self.partial_request_bytes()):
            limit_mib = MAX_PARTIAL_REQUEST_BYTES >> 20
            text = f"incomplete requests of all clients exceed {limit_mib} MiB: try again later"
            self.refuse(*self._reader.discard_partial("busy", text))
        self._watch_partial_request()
        transport = self._transport
        if (
            transport is not None
            and transport.get_write_buffer_size() > MAX_CLIENT_BACKLOG_BYTES + MAX_REPLY_BACKLOG_BYTES
        ):
            transport.pause_reading()

    def _watch_partial_request(self) -> None:
        """Starts or cancels the timeout for an incomplete request."""
        if self.spare:
            return
        held = self.partial_request_bytes()
        if held and self._deadline is None:
            self._received_before = self._received_bytes
            self._deadline = asyncio.get_running_loop().call_later(
                PARTIAL_REQUEST_TIMEOUT_S, self._check_partial_request
            )
        elif not held and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _check_partial_request(self) -> None:
        self._deadline = None
        # While the client does not read, its requests are not read either.
        is_reading = self._transport is not None and self._transport.is_reading()
        if is_reading and self._received_bytes == self._received_before:
            self.refuse(None, "too-slow", f"request incomplete: no data for {PARTIAL_REQUEST_TIMEOUT_S:g} s")
            self.close()
        else:
            self._watch_partial_request()

    def _handle(self, frame: Frame) -> None:
        header, payload = frame
        if self.spare and header.get("op") not in SPARE_OPS:
            self.refuse(header.get("id"), "too-many-clients", self._server.too_many_clients_text())
            self.close()
            return
        try:
            self._server.requests.request(self, header, payload)
        except RequestError as error:
            self.refuse(header.get("id"), error.code, str(error))
        if self.spare:
            self.close()

    def resume_writing(self) -> None:
        # All but a few kilobytes have been read.
        if self._transport is not None:
            self._transport.resume_reading()
        self._server.requests.client_read()
        if self._dropped:
            self._report_dropped()

    def connection_lost(self, exc: Exception | None) -> None:
        self._transport = None
        if self._deadline is not None:
            self._deadline.cancel()
        self._server.clients.discard(self)
        self._server.spares.pop(self, None)
        self._server.requests.client_gone(self)


class LocalServer:
    """The listening socket and its connections."""

    def __init__(
        self,
        requests: RequestHandler,
        path: Path,
        *,
        mode: int,
        group: str | None,
        max_payload_bytes: Callable[[], int],
    ) -> None:
        self.requests = requests
        self.clients: set[Client] = set()
        self.spares: dict[Client, None] = {}
        """Connections beyond the limit, oldest first."""
        self.max_payload_bytes = max_payload_bytes
        self.dropped_for_slow_clients = 0
        self._listener = Listener(path, mode=mode, group=group, on_connection=self._on_connection)
        self._max_clients = MAX_CLIENTS
        self._connecting: dict[Client, asyncio.Task[None]] = {}
        """Accepted connections without a transport yet. They count: the loop may accept more in the meantime."""

    async def start(self) -> None:
        """Listens. Raises OSError: in use by another daemon, no such directory or group, permission denied."""
        self._max_clients = max(1, raise_descriptor_limit(MAX_CLIENTS + RESERVED_DESCRIPTORS) - RESERVED_DESCRIPTORS)
        self._listener.open()

    def _on_connection(self, connection: socket.socket) -> None:
        """Handles a new connection."""
        making = sum(not client.spare for client in self._connecting)
        spare = len(self.clients) + making >= self._max_clients
        if spare and len(self._connecting) - making >= 2 * MAX_SPARE_CLIENTS:
            # Do not wait for a new connection that cannot be written to at once.
            with connection, contextlib.suppress(OSError):
                rejected = {"event": "rejected", "code": "too-many-clients", "error": self.too_many_clients_text()}
                connection.send(encode_frame(rejected, b""))
            return
        client = Client(self, spare=spare)
        self._connecting[client] = asyncio.get_running_loop().create_task(self._connect(client, connection))

    async def _connect(self, client: Client, connection: socket.socket) -> None:
        try:
            await asyncio.get_running_loop().connect_accepted_socket(lambda: client, connection)
        except OSError:
            connection.close()
        finally:
            self._connecting.pop(client, None)

    def on_connected(self, client: Client) -> None:
        """Registers a connection once its transport exists."""
        self._connecting.pop(client, None)
        if client.spare:
            self.spares[client] = None
            if len(self.spares) > MAX_SPARE_CLIENTS:
                next(iter(self.spares)).reject()
        else:
            self.clients.add(client)

    def too_many_clients_text(self) -> str:
        """The error text for a connection beyond the limit."""
        return f"too many clients: at most {self._max_clients} may connect at a time"

    def exceeds_backlog_share(self, waiting: int) -> bool:
        """Whether a client with this backlog exceeds its share of the total limit."""
        return self._exceeds_share(waiting, MAX_TOTAL_BACKLOG_BYTES, Client.backlog_bytes)

    def exceeds_partial_request_share(self, held: int) -> bool:
        """Whether a client with this much of an incomplete request exceeds its share of the total limit."""
        return self._exceeds_share(held, MAX_PARTIAL_REQUEST_BYTES, Client.partial_request_bytes)

    def _exceeds_share(self, own: int, limit: int, of_each: Callable[[Client], int]) -> bool:
        """Whether the total exceeds `limit` and `own` exceeds an equal share of it."""
        return own > limit // max(1, len(self.clients)) and sum(map(of_each, self.clients)) > limit

    async def close(self) -> None:
        """Stops listening, flushes and closes every connection, removes the socket file."""
        self._listener.close()
        await asyncio.gather(*self._connecting.values())
        for client in [*self.clients, *self.spares]:
            client.close()
        await asyncio.sleep(0)


def _peer_uid(connection: socket.socket | None) -> int | None:
    """The user id of the process at the other end (unix(7), SO_PEERCRED)."""
    if connection is None:
        return None
    try:
        _, user, _ = _CREDENTIALS.unpack(
            connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        )
    except OSError:
        return None
    return int(user)


def raise_descriptor_limit(wanted: int) -> int:
    """The number of files this process may open, after raising the soft limit toward `wanted`."""
    try:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    except OSError:
        # A sandbox may hide the limit.
        return wanted
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return wanted
    raised = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (raised, hard))
        return raised
    return soft
