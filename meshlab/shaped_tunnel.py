"""Forward one TCP connection of the operator to a node, over links that may be slow, lossy or cut at any moment.

A cut link does not close the connection but stalls it: bytes wait until there is a path again. So does a node that
loses power: the operator notices when the node is back and resets the connection, or by its own timeout.
"""

from __future__ import annotations

import asyncio
import contextlib
import random
import socket
import struct
from collections.abc import Callable
from dataclasses import dataclass

_CHUNK_BYTES = 16 * 1024
_PACKET_BYTES = 1448
# Linux's minimum retransmission timeout
_RETRANSMIT_S = 0.2
# chunks in flight per direction: the limit that makes a slow link slow its sender down
_IN_FLIGHT_CHUNKS = 16


@dataclass(frozen=True, slots=True)
class Shape:
    """One-way delay, loss 0..1 and rate in bytes per second (None: unlimited) of a path."""

    delay_s: float = 0.0
    loss: float = 0.0
    rate_bytes_s: float | None = None

    def hold_s(self, size: int, rng: random.Random) -> float:
        """The time for `size` bytes at the path's rate, plus one retransmission timeout per lost packet."""
        lost = sum(rng.random() < self.loss for _ in range(-(-size // _PACKET_BYTES))) if self.loss else 0
        return (size / self.rate_bytes_s if self.rate_bytes_s else 0.0) + lost * (_RETRANSMIT_S + 2 * self.delay_s)


class Tunnel:
    """Forwards bytes between `client` and `node` until both directions ended or the node reset the connection.

    `shape()` returns the current path, None while it is cut; `changed` is notified when it may have changed;
    `is_same_boot()` is false once the node has restarted since the connection was made.
    """

    def __init__(
        self,
        client: socket.socket,
        node: socket.socket,
        shape: Callable[[], Shape | None],
        changed: asyncio.Condition,
        is_same_boot: Callable[[], bool],
        rng: random.Random,
    ) -> None:
        self._client = client
        self._node = node
        self._shape = shape
        self._changed = changed
        self._is_same_boot = is_same_boot
        self._rng = rng

    async def run(self) -> None:
        """Forward until the connection ends; closes both sockets."""
        tasks = [
            asyncio.ensure_future(self._forward(self._client, self._node, from_node=False)),
            asyncio.ensure_future(self._forward(self._node, self._client, from_node=True)),
        ]
        try:
            await asyncio.gather(*tasks)
        except OSError:
            reset(self._client)
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            self._client.close()
            self._node.close()

    async def _forward(self, source: socket.socket, target: socket.socket, *, from_node: bool) -> None:
        loop = asyncio.get_running_loop()
        flying: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_IN_FLIGHT_CHUNKS)

        async def take() -> None:
            line_free = 0.0
            while True:
                try:
                    data = await loop.sock_recv(source, _CHUNK_BYTES)
                except OSError:
                    if not from_node:
                        raise
                    data = b""
                shape = await self._wait_for_path()
                if from_node and not data and not self._is_same_boot():
                    raise ConnectionResetError("the node has restarted")
                line_free = max(line_free, loop.time()) + shape.hold_s(len(data), self._rng)
                await flying.put((line_free + shape.delay_s, data))
                if not data:
                    return

        async def give() -> None:
            while True:
                due, data = await flying.get()
                await asyncio.sleep(max(0.0, due - loop.time()))
                await self._wait_for_path()
                if not from_node and not self._is_same_boot():
                    raise ConnectionResetError("the node has restarted")
                if not data:
                    with contextlib.suppress(OSError):
                        target.shutdown(socket.SHUT_WR)
                    return
                await loop.sock_sendall(target, data)

        halves = [asyncio.ensure_future(take()), asyncio.ensure_future(give())]
        try:
            await asyncio.gather(*halves)
        finally:
            for half in halves:
                half.cancel()
            await asyncio.gather(*halves, return_exceptions=True)

    async def _wait_for_path(self) -> Shape:
        """Wait until there is a path; returns it."""
        shape = self._shape()
        while shape is None:
            async with self._changed:
                await self._changed.wait()
            shape = self._shape()
        return shape


def reset(connection: socket.socket) -> None:
    """Make close() send a TCP reset."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
