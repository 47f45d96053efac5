"""A UDP socket that puts messages together from datagrams, for the transports written from their wire behavior."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

# a burst of two bulk messages and more
_BUFFER_BYTES = 1 << 20


class _Protocol(asyncio.DatagramProtocol):
    def __init__(self, add: Callable[[bytes], bytes | None], on_message: Callable[[bytes], None]) -> None:
        self._add, self._on_message = add, on_message

    def datagram_received(self, data: bytes, _: Any) -> None:
        whole = self._add(data)
        if whole is not None:
            self._on_message(whole)


@asynccontextmanager
async def receiving(
    port: int, add: Callable[[bytes], bytes | None], on_message: Callable[[bytes], None]
) -> AsyncIterator[None]:
    """Pass every datagram that arrives at `port` to `add`, and each message that this completes to `on_message`."""
    bound = socket.socket(type=socket.SOCK_DGRAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    bound.bind(("", port))
    bound.setblocking(False)
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(lambda: _Protocol(add, on_message), sock=bound)
    try:
        yield
    finally:
        transport.close()
