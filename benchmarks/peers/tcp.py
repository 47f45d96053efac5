"""TCP with length-prefixed messages: one connection for bulk, one for urgent messages, as a careful user would do."""

from __future__ import annotations

import asyncio
import socket
import struct
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from benchmarks.peers import PORT

_LENGTH = struct.Struct("<I")
# enough to keep a link busy, without adding a long queue (two bulk messages)
_WRITE_BUFFER_BYTES = 100_000


@dataclass(frozen=True, slots=True)
class _Sender:
    bulk_writer: asyncio.StreamWriter
    urgent_writer: asyncio.StreamWriter

    async def bulk(self, data: bytes) -> None:
        self.bulk_writer.write(_LENGTH.pack(len(data)) + data)
        await self.bulk_writer.drain()

    async def urgent(self, data: bytes) -> None:
        self.urgent_writer.write(_LENGTH.pack(len(data)) + data)


@dataclass(frozen=True, slots=True)
class _Transport:
    congestion_control: str

    def _socket(self) -> socket.socket:
        made = socket.socket()
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, self.congestion_control.encode())
        made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return made

    async def _connect(self, address: str) -> asyncio.StreamWriter:
        made = self._socket()
        made.setblocking(False)
        await asyncio.get_running_loop().sock_connect(made, (address, PORT))
        _, writer = await asyncio.open_connection(sock=made)
        writer.transport.set_write_buffer_limits(high=_WRITE_BUFFER_BYTES)
        return writer

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        writers = [await self._connect(address) for _ in range(2)]
        try:
            yield _Sender(*writers)
        finally:
            for writer in writers:
                writer.transport.abort()

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                while True:
                    (length,) = _LENGTH.unpack(await reader.readexactly(_LENGTH.size))
                    on_message(await reader.readexactly(length))
            except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
                # the sender has ended, or this end is closing
                writer.transport.abort()

        listening = self._socket()
        listening.bind(("", PORT))
        async with await asyncio.start_server(serve, sock=listening, limit=1 << 20):
            yield


def transport(variant: str) -> _Transport:
    return _Transport(variant)
