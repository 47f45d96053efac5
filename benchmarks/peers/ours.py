"""udp_mesh itself, encrypted: the library node of `udp_mesh`, bulk and urgent as two topics of two priorities."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import Literal

from udp_mesh import Node
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.crypto import Key

# only used by the two ends of a benchmark
_KEY = Key.parse("be" * 32)
_TOPICS = (Topic("urgent", priority=0), Topic("bulk", priority=8))
# enough to keep a fast link busy, like the other transports' buffers
_UNDER_WAY = 40
_DISCOVERY_S = 30.0


def _settings(name: str, variant: str) -> Settings:
    window: Literal["adaptive"] | int = "adaptive" if variant == "adaptive" else int(variant)
    return Settings(name, keys=(_KEY,), topics=_TOPICS, window=window)


class _Sender:
    def __init__(self, node: Node) -> None:
        self._node = node
        self._room = asyncio.Semaphore(_UNDER_WAY)
        self._tasks: set[asyncio.Task[None]] = set()

    async def bulk(self, data: bytes) -> None:
        await self._room.acquire()
        task = asyncio.create_task(self._deliver(data))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        await asyncio.sleep(0)

    async def _deliver(self, data: bytes) -> None:
        try:
            await self._node.deliver("bulk", data, to="receiver")
        finally:
            self._room.release()

    async def urgent(self, data: bytes) -> None:
        await self._node.send("urgent", data, to="receiver")

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        with suppress(asyncio.CancelledError):
            await asyncio.gather(*self._tasks, return_exceptions=True)


@dataclass(frozen=True, slots=True)
class _Transport:
    variant: str

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        async with Node(_settings("sender", self.variant)) as node:
            async with asyncio.timeout(_DISCOVERY_S):
                # the receiver is discovered by its heartbeat; the address is for the other transports
                while not any(peer.name == "receiver" and peer.online for peer in node.conditions().peers):  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
            sender = _Sender(node)
            try:
                yield sender
            finally:
                await sender.close()

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        async with Node(_settings("receiver", self.variant)) as node:

            async def read() -> None:
                async for received in node.messages():
                    assert isinstance(received, MessageReceived)
                    on_message(received.payload)

            reading = asyncio.create_task(read())
            try:
                yield
            finally:
                reading.cancel()
                with suppress(asyncio.CancelledError):
                    await reading


def transport(variant: str) -> _Transport:
    return _Transport(variant)
