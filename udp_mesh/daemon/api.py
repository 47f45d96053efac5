"""The local API's transport: a Unix socket, frames in, frames out (docs/local-api.md).

A connection hands each request to the service and writes what the service gives back. What a slow reader does not
fetch is bounded: past `CLIENT_BACKLOG_BYTES` messages for it are dropped, and it is told how many once it reads
again; past `REPLIES_BACKLOG_BYTES` more its own requests wait. Other readers and the mesh never wait for it. A message
for a program that has read everything is never dropped, however large.
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
"""Bytes written to one client and not yet read by it: a stopped subscriber. A few of the largest usual messages."""
MAX_TOTAL_BACKLOG_BYTES = 256 << 20
"""The same for all clients together: past it, who holds more than an equal part of that gets no more."""
MAX_PARTIAL_REQUEST_BYTES = 256 << 20
"""Bytes of requests that are not there whole, of all clients together: past it, who holds more than an equal part of
that has its request refused. Several of the largest messages at a time."""
MAX_REPLY_BACKLOG_BYTES = 4 << 20
"""Bytes of replies beyond that: a program that asks without end and never reads the answers."""
MAX_CLIENTS = 256
"""Connections at a time: a program that leaks them must not take the daemon's descriptors."""
MAX_SPARE_CLIENTS = 8
"""Connections beyond that, for one look at what is wrong: they may ask `LOOKS`, once and soon. For one more of them the
oldest gives way."""
SPARE_OPS = ("status", "metrics")
SPARE_TIMEOUT_S = 2.0
PARTIAL_REQUEST_TIMEOUT_S = 30.0
"""A request that stops coming for this long is given up, and its connection closed."""
RESERVED_DESCRIPTORS = 40
"""Files for the daemon's own needs, whatever its limit: links, kernel's notices, outbox, recording, configuration, a
scraper."""


_CREDENTIALS = struct.Struct("iII")


class RequestError(Exception):
    """A request that is refused; `code` is a word for programs, the text is for people."""

    def __init__(self, code: str, text: str) -> None:
        super().__init__(text)
        self.code = code


class RequestHandler(Protocol):
    """Who answers."""

    def request(self, client: Client, header: Header, payload: bytes) -> None:
        """Answers now or later through `client`; raises RequestError to refuse."""
        ...

    def client_gone(self, client: Client) -> None: ...


class Client(asyncio.Protocol):
    """One connected program."""

    def __init__(self, server: LocalServer, *, spare: bool = False) -> None:
        self._server = server
        self.spare = spare
        """Beyond the connections there may be: it gets one look."""
        self.user: int | None = None
        """Whose program it is; None where the kernel does not say."""
        self._deadline: asyncio.TimerHandle | None = None
        self._partial_before = 0
        self._reader = RequestReader(server.max_payload_bytes)
        self._transport: asyncio.Transport | None = None
        self._dropped = 0

    # What the service calls

    def reply(self, request_id: object, payload: bytes = b"", **fields: object) -> None:
        """Answers a request; one without an id wanted no answer."""
        if request_id is not None:
            self._write({"id": request_id, "ok": True, **fields}, payload)

    def refuse(self, request_id: object, code: str, text: str) -> None:
        """Refuses a request; one without an id hears of it as an event."""
        if request_id is None:
            self._write({"event": "rejected", "code": code, "error": text})
        else:
            self._write({"id": request_id, "ok": False, "code": code, "error": text})

    def send_event(self, header: Header, payload: bytes = b"") -> None:
        """An event; dropped and counted where the program does not read."""
        if self._transport is not None:
            self.send_encoded(encode_frame(header, payload))

    def send_encoded(self, frame: bytes) -> None:
        """As `tell`, for a frame that several clients get."""
        transport = self._transport
        if transport is None:
            return
        waiting = self.backlog_bytes()
        if waiting and (waiting + len(frame) > MAX_CLIENT_BACKLOG_BYTES or self._server.exceeds_backlog_share(waiting)):
            self._dropped += 1
            self._server.dropped_for_slow_clients += 1
            return
        if self._dropped:
            self._report_dropped()
        transport.write(frame)

    def partial_request_bytes(self) -> int:
        """Bytes of a request that is not here whole."""
        return self._reader.buffered_bytes

    def backlog_bytes(self) -> int:
        """Bytes written and not yet read."""
        return 0 if self._transport is None else self._transport.get_write_buffer_size()

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()

    def _report_dropped(self) -> None:
        dropped, self._dropped = self._dropped, 0
        self._write({"event": "dropped", "messages": dropped})

    def _write(self, header: Header, payload: bytes = b"") -> None:
        if self._transport is not None:
            self._transport.write(encode_frame(header, payload))

    # What asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.Transport, transport)
        self.user = _peer_uid(transport.get_extra_info("socket"))
        self._server.on_connected(self)
        if self.spare:
            self._deadline = asyncio.get_running_loop().call_later(SPARE_TIMEOUT_S, self.reject)

    def reject(self) -> None:
        """There is no room for it."""
        self._server.spares.pop(self, None)
        self.refuse(None, "too-many-clients", self._server.too_many_clients_text())
        self.close()

    def data_received(self, data: bytes) -> None:
        for frame in self._reader.feed(data):
            if isinstance(frame, BadFrame):
                self.refuse(*frame)
            else:
                self._handle(frame)
        if self._server.exceeds_partial_request_share(self.partial_request_bytes()):
            limit_mib = MAX_PARTIAL_REQUEST_BYTES >> 20
            text = f"local programs have begun to send more than {limit_mib} MiB at a time: try again"
            self.refuse(*self._reader.discard_partial("busy", text))
        self._watch_partial_request()
        transport = self._transport
        if (
            transport is not None
            and transport.get_write_buffer_size() > MAX_CLIENT_BACKLOG_BYTES + MAX_REPLY_BACKLOG_BYTES
        ):
            transport.pause_reading()

    def _watch_partial_request(self) -> None:
        """While a request is not here whole, some of the rest must come now and then."""
        if self.spare:
            return
        held = self.partial_request_bytes()
        if held and self._deadline is None:
            self._partial_before = held
            self._deadline = asyncio.get_running_loop().call_later(
                PARTIAL_REQUEST_TIMEOUT_S, self._check_partial_request
            )
        elif not held and self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _check_partial_request(self) -> None:
        self._deadline = None
        if self.partial_request_bytes() == self._partial_before:
            self.refuse(None, "too-slow", f"a request stopped coming for {PARTIAL_REQUEST_TIMEOUT_S:g} s")
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
        # What was written is read, all but a few kilobytes.
        if self._transport is not None:
            self._transport.resume_reading()
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
        """Connections beyond the most, the oldest first."""
        self.max_payload_bytes = max_payload_bytes
        self.dropped_for_slow_clients = 0
        self._listener = Listener(path, mode=mode, group=group, on_connection=self._on_connection)
        self._max_clients = MAX_CLIENTS
        self._connecting: dict[Client, asyncio.Task[None]] = {}
        """Accepted, their transports not yet made: they count already, since the loop may accept more meanwhile."""

    async def start(self) -> None:
        """Listens. Raises OSError: in use by another daemon, no such directory, no such group, not allowed."""
        self._max_clients = max(1, raise_descriptor_limit(MAX_CLIENTS + RESERVED_DESCRIPTORS) - RESERVED_DESCRIPTORS)
        self._listener.open()

    def _on_connection(self, connection: socket.socket) -> None:
        """A program has connected."""
        making = sum(not client.spare for client in self._connecting)
        spare = len(self.clients) + making >= self._max_clients
        if spare and len(self._connecting) - making >= 2 * MAX_SPARE_CLIENTS:
            # What cannot be written at once to a fresh connection is not worth waiting for.
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
        """A program's connection can be used."""
        self._connecting.pop(client, None)
        if client.spare:
            self.spares[client] = None
            if len(self.spares) > MAX_SPARE_CLIENTS:
                next(iter(self.spares)).reject()
        else:
            self.clients.add(client)

    def too_many_clients_text(self) -> str:
        """Why a program is turned away."""
        return f"at most {self._max_clients} programs connect at a time"

    def exceeds_backlog_share(self, waiting: int) -> bool:
        """Whether a client for which so many bytes wait must not get more for all others' sake."""
        return self._exceeds_share(waiting, MAX_TOTAL_BACKLOG_BYTES, Client.backlog_bytes)

    def exceeds_partial_request_share(self, held: int) -> bool:
        """Whether a client that has sent so much of a request must not send the rest of it for all others' sake."""
        return self._exceeds_share(held, MAX_PARTIAL_REQUEST_BYTES, Client.partial_request_bytes)

    def _exceeds_share(self, own: int, limit: int, of_each: Callable[[Client], int]) -> bool:
        """Whether this is more than an equal part of a limit that all together exceed."""
        return own > limit // max(1, len(self.clients)) and sum(map(of_each, self.clients)) > limit

    async def close(self) -> None:
        """Stops listening, lets what is written be read, closes every connection, removes the socket's file."""
        self._listener.close()
        await asyncio.gather(*self._connecting.values())
        for client in [*self.clients, *self.spares]:
            client.close()
        await asyncio.sleep(0)


def _peer_uid(connection: socket.socket | None) -> int | None:
    """The user id of the program at the other end (unix(7), SO_PEERCRED)."""
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
    """How many files this process may open, after asking for as many as `wanted` where the limit is lower."""
    try:
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    except OSError:
        # a sandbox that does not tell
        return wanted
    if soft == resource.RLIM_INFINITY or soft >= wanted:
        return wanted
    raised = wanted if hard == resource.RLIM_INFINITY else min(hard, wanted)
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (raised, hard))
        return raised
    return soft
