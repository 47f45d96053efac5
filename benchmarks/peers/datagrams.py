"""A UDP socket that passes each datagram to a function, for the transports written from their wire behavior."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any

# a burst of two bulk messages and more
_BUFFER_BYTES = 1 << 20


class _Protocol(asyncio.DatagramProtocol):
    def __init__(self, take: Callable[[bytes], None]) -> None:
        self._take = take

    def datagram_received(self, data: bytes, _: Any) -> None:
        self._take(data)


@asynccontextmanager
async def receiving(port: int, take: Callable[[bytes], None]) -> AsyncIterator[None]:
    """Pass every datagram that arrives at `port` to `take`."""
    bound = socket.socket(type=socket.SOCK_DGRAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
    bound.bind(("", port))
    bound.setblocking(False)
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(lambda: _Protocol(take), sock=bound)
    try:
        yield
    finally:
        transport.close()
