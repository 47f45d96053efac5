"""Round trips to peers' daemons, through both cores, and the answers to theirs."""

from __future__ import annotations

import asyncio
import os

from udp_mesh.core.events import MessageReceived, Rejected
from udp_mesh.daemon.api import RequestError
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.interface import PING_TOPIC, PONG_TOPIC

TOKEN_BYTES = 8


class Pings:
    """Pings of this daemon that wait for their answers."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._waiting: dict[bytes, asyncio.Future[float]] = {}

    async def ping(self, peer: str, timeout_s: float) -> float:
        """Measures the round trip to the peer's daemon, in seconds. Raises RequestError."""
        token = os.urandom(TOKEN_BYTES)
        answer: asyncio.Future[float] = asyncio.get_running_loop().create_future()
        self._waiting[token] = answer
        begun = self._driver.now()
        try:
            outcome = self._driver.send(PING_TOPIC, token, destination=peer)
            if isinstance(outcome, Rejected):
                raise RequestError(outcome.reason.value.replace(" ", "-"), outcome.detail)
            async with asyncio.timeout(timeout_s):
                return await answer - begun
        except TimeoutError as error:
            raise RequestError("no-answer", f"{peer} did not answer within {timeout_s:g} s") from error
        finally:
            del self._waiting[token]

    def on_message(self, message: MessageReceived) -> bool:
        """Answers a ping, or takes the answer to one. Returns whether it was either."""
        if message.topic == PING_TOPIC and len(message.payload) == TOKEN_BYTES:
            self._driver.send(PONG_TOPIC, message.payload, destination=message.source)
        elif message.topic == PONG_TOPIC:
            waiting = self._waiting.get(message.payload)
            if waiting is not None and not waiting.done():
                waiting.set_result(self._driver.now())
        else:
            return False
        return True
