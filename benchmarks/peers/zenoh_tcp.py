"""Zenoh over TCP, tuned as its documentation advises: urgent at REAL_TIME and express, bulk at BACKGROUND."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Any

import zenoh

from benchmarks.peers import PORT

_MATCH_TIMEOUT_S = 30.0


def open_session(listen: list[str], dial: list[str]) -> Any:
    configuration = zenoh.Config()
    for key, value in (
        ("mode", "peer"), ("scouting/multicast/enabled", False), ("scouting/gossip/enabled", False),
        ("transport/shared_memory/enabled", False), ("listen/endpoints", listen), ("connect/endpoints", dial),
    ):  # fmt: skip
        configuration.insert_json5(key, json.dumps(value))
    return zenoh.open(configuration)


@dataclass(frozen=True, slots=True)
class _Sender:
    bulk_publisher: Any
    urgent_publisher: Any

    async def bulk(self, data: bytes) -> None:
        # BLOCK waits in the caller's thread
        await asyncio.to_thread(self.bulk_publisher.put, data)

    async def urgent(self, data: bytes) -> None:
        await asyncio.to_thread(self.urgent_publisher.put, data)


@dataclass(frozen=True, slots=True)
class _Transport:
    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        session = await asyncio.to_thread(open_session, [], [f"tcp/{address}:{PORT}"])
        try:
            publishers = [
                session.declare_publisher(
                    key, priority=priority, express=express, congestion_control=zenoh.CongestionControl.BLOCK,
                    reliability=zenoh.Reliability.RELIABLE,
                )
                for key, priority, express in (
                    ("bulk", zenoh.Priority.BACKGROUND, False), ("urgent", zenoh.Priority.REAL_TIME, True),
                )
            ]  # fmt: skip
            async with asyncio.timeout(_MATCH_TIMEOUT_S):
                # matching can only be polled
                while not all(publisher.matching_status.matching for publisher in publishers):  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
            yield _Sender(*publishers)
        finally:
            await asyncio.to_thread(session.close)

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        session = await asyncio.to_thread(open_session, [f"tcp/0.0.0.0:{PORT}"], [])
        subscribers = [
            session.declare_subscriber(key, lambda sample: on_message(sample.payload.to_bytes()))
            for key in ("bulk", "urgent")
        ]
        try:
            yield
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()
            await asyncio.to_thread(session.close)


def transport(variant: str) -> _Transport:
    assert variant == "priorities"
    return _Transport()
