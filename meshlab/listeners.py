"""Listening sockets on addresses of 127/8, at one port per fleet: opened and closed to match what is reachable now."""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable, Hashable, Set
from typing import Generic, TypeVar

from meshlab.errors import LabError

log = logging.getLogger("meshlab.listeners")
_BACKLOG = 16
# tried in order when the fleet's spec has no port
_FIRST_PORT, _LAST_PORT = 20022, 20999

Target = TypeVar("Target", bound=Hashable)


class Listeners(Generic[Target]):
    """One listening socket per target, on the host that `host_of` gives; `serve` handles each connection to it."""

    def __init__(
        self, host_of: Callable[[Target], str], serve: Callable[[Target, socket.socket], Awaitable[None]]
    ) -> None:
        self._host_of = host_of
        self._serve = serve
        self._listening: dict[Target, tuple[socket.socket, asyncio.Task[None]]] = {}
        self._connections: set[asyncio.Task[None]] = set()

    def update(self, targets: Set[Target], port: int) -> None:
        """Listen for exactly these targets; established connections stay."""
        for target in self._listening.keys() - targets:
            listener, task = self._listening.pop(target)
            task.cancel()
            listener.close()
        for target in targets - self._listening.keys():
            listener = socket.socket()
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            host = self._host_of(target)
            try:
                listener.bind((host, port))
            except OSError as error:
                listener.close()
                log.error("port-in-use host=%s port=%d error=%s", host, port, error)
                continue
            listener.listen(_BACKLOG)
            listener.setblocking(False)
            self._listening[target] = (listener, asyncio.ensure_future(self._accept(target, listener)))

    async def close(self) -> None:
        """Close all sockets and end all connections."""
        tasks = [*(task for _, task in self._listening.values()), *self._connections]
        for task in self._connections:
            task.cancel()
        self.update(set(), 0)
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _accept(self, target: Target, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            client, _ = await loop.sock_accept(listener)
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            task = asyncio.ensure_future(self._serve(target, client))
            self._connections.add(task)
            task.add_done_callback(self._connections.discard)


def lock_port(requested: int) -> tuple[socket.socket, int]:
    """A socket that holds the fleet's port, and the port: `requested`, or a free one for 0.

    Raises LabError when the port (or every port of the range) is in use.
    """
    for port in (requested,) if requested else range(_FIRST_PORT, _LAST_PORT + 1):
        claim = socket.socket()
        try:
            claim.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            claim.bind(("127.255.255.254", port))
            claim.listen(1)
        except OSError:
            claim.close()
            continue
        return claim, port
    if requested:
        raise LabError(
            f"port {requested} on 127.255.255.254 is in use", hint="another fleet may run; choose another --port"
        )
    raise LabError(
        f"ports {_FIRST_PORT} to {_LAST_PORT} on 127.255.255.254 are all in use",
        hint="stop another fleet, or choose --port",
    )
