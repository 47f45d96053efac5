"""Answers Prometheus over TCP on a loopback address: one request, one page, closed (RFC 9112, as little as it
takes)."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from udp_mesh.core.settings import Address
from udp_mesh.daemon.metrics import CONTENT_TYPE

MAX_REQUEST_BYTES = 8192
"""A scraper's request is a few hundred bytes; more is refused."""
REQUEST_TIMEOUT_S = 5.0
"""A connection that says nothing is closed."""
MAX_CONNECTIONS = 8
"""At a time, for the daemon's descriptors' sake. For one more the oldest gives way: a scraper asks at once, and
who holds connections without asking must not keep it out."""


class MetricsServer:
    """Serves `GET /metrics`."""

    def __init__(self, address: Address, render: Callable[[], str]) -> None:
        self._address = address
        self._render = render
        self._server: asyncio.Server | None = None
        self._open: dict[asyncio.StreamWriter, None] = {}

    async def start(self) -> None:
        """Raises OSError where the port is taken."""
        host, port = self._address
        # asyncio accepts as many at a time as may wait
        self._server = await asyncio.start_server(
            self._answer, host, port, limit=MAX_REQUEST_BYTES, backlog=MAX_CONNECTIONS
        )

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open[writer] = None
        if len(self._open) > MAX_CONNECTIONS:
            oldest = next(iter(self._open))
            del self._open[oldest]
            oldest.transport.abort()
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                request = await reader.readuntil(b"\r\n\r\n")
                method, _, rest = request.partition(b"\r\n")[0].partition(b" ")
                path = rest.partition(b" ")[0].partition(b"?")[0]
                if method in (b"GET", b"HEAD") and path == b"/metrics":
                    status, body = "200 OK", self._render().encode()
                else:
                    status, body = "404 Not Found", b"GET /metrics\n"
                head = f"HTTP/1.1 {status}\r\nContent-Type: {CONTENT_TYPE}\r\nContent-Length: {len(body)}\r\n"
                writer.write(head.encode() + b"Connection: close\r\n\r\n" + (b"" if method == b"HEAD" else body))
                await writer.drain()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            # A scraper that went away or never asked: nothing to answer.
            return
        finally:
            self._open.pop(writer, None)
            writer.close()

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
