"""One TCP connection of the operator carried into a node, over links that may be slow, lossy or cut at any moment.

A cut link does not close a connection, it stops it: bytes wait until there is a path again. So does the death of a
node: the operator learns of it when the node is back and answers with a reset, or by its own deadline.
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
# Linux' least retransmission timeout
_RETRANSMIT_S = 0.2
# what may be on its way in one direction, so that a slow link slows its sender down
_IN_FLIGHT_CHUNKS = 16


@dataclass(frozen=True, slots=True)
class Shape:
    """What a path does to packets: one-way delay, loss 0..1, bytes per second (None: unlimited)."""

    delay_s: float = 0.0
    loss: float = 0.0
    rate_bytes_s: float | None = None

    def hold_s(self, size: int, dice: random.Random) -> float:
        """How long `size` bytes take: the wire's rate, and one retransmission timeout for each packet lost."""
        lost = sum(dice.random() < self.loss for _ in range(-(-size // _PACKET_BYTES))) if self.loss else 0
        return (size / self.rate_bytes_s if self.rate_bytes_s else 0.0) + lost * (_RETRANSMIT_S + 2 * self.delay_s)


class Tunnel:
    """Carries bytes between `client` and `node` until both directions ended, the node reset it, or `abort`.

    `shape()` gives the path at this moment, None while it is cut; `changed` is notified when that may be different;
    `is_same_boot()` tells whether the node is still the one that was connected to.
    """

    def __init__(
        self,
        client: socket.socket,
        node: socket.socket,
        shape: Callable[[], Shape | None],
        changed: asyncio.Condition,
        is_same_boot: Callable[[], bool],
        dice: random.Random,
    ) -> None:
        self._client = client
        self._node = node
        self._shape = shape
        self._changed = changed
        self._is_same_boot = is_same_boot
        self._dice = dice

    async def run(self) -> None:
        """Returns when the connection is over; closes both sockets."""
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
                shape = await self._path()
                if from_node and not data and not self._is_same_boot():
                    raise ConnectionResetError("the node has been off in between")
                line_free = max(line_free, loop.time()) + shape.hold_s(len(data), self._dice)
                await flying.put((line_free + shape.delay_s, data))
                if not data:
                    return

        async def give() -> None:
            while True:
                due, data = await flying.get()
                await asyncio.sleep(max(0.0, due - loop.time()))
                await self._path()
                if not from_node and not self._is_same_boot():
                    raise ConnectionResetError("the node has been off in between")
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

    async def _path(self) -> Shape:
        """The path, once there is one."""
        shape = self._shape()
        while shape is None:
            async with self._changed:
                await self._changed.wait()
            shape = self._shape()
        return shape


def reset(connection: socket.socket) -> None:
    """Close with a TCP reset instead of an orderly end."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
