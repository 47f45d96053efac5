"""A minimal HTTP server for Prometheus on a loopback address: one request, one response, close (RFC 9112)."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from udp_mesh.core.settings import Address
from udp_mesh.daemon.metrics import CONTENT_TYPE

MAX_REQUEST_BYTES = 8192
"""Maximum request size; a scraper's request is a few hundred bytes."""
REQUEST_TIMEOUT_S = 5.0
"""An idle connection is closed after this."""
MAX_CONNECTIONS = 8
"""Concurrent connections, to bound the daemon's descriptors. A further one evicts the oldest: a scraper sends its
request at once, and idle connections must not keep it out."""


class MetricsServer:
    """Serves `GET /metrics`."""

    def __init__(self, address: Address, render: Callable[[], str]) -> None:
        self._address = address
        self._render = render
        self._server: asyncio.Server | None = None
        self._open: dict[asyncio.StreamWriter, None] = {}

    async def start(self) -> None:
        """Raises OSError if the port is in use."""
        host, port = self._address
        # asyncio accepts up to `backlog` connections at a time.
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
            # The scraper went away or sent no request.
            return
        finally:
            self._open.pop(writer, None)
            writer.close()

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            await self._server.wait_closed()
