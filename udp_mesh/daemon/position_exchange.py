"""Sends this node's position to its peers once it is due, and passes theirs to the status and the recording."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from udp_mesh.core.events import MessageReceived
from udp_mesh.daemon.driver import Driver
from udp_mesh.daemon.interface import POSITION_TOPIC
from udp_mesh.daemon.positions import Json, Position, Positions
from udp_mesh.daemon.recording import Recorder

POSITION_TYPE = "position"
"""No type of ROS: legacy programs do not get it."""
CHECK_S = 1.0
"""Interval of the check whether a message is due."""


class PositionExchange:
    """The positions of a running daemon with this node name; `recorder` is the recording, if there is one now."""

    def __init__(
        self, driver: Driver, name: str, fixed: Position | None, recorder: Callable[[], Recorder | None]
    ) -> None:
        self._driver, self._name, self._recorder = driver, name, recorder
        self._positions = Positions(fixed)
        self._timer: asyncio.TimerHandle | None = None

    def start(self) -> None:
        """Starts sending."""
        self._timer = asyncio.get_running_loop().call_later(CHECK_S, self.start)
        self._send()

    def close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()

    def set_own(self, position: Position) -> None:
        """A program tells where this node is."""
        self._positions.set_own(position)
        self._send()

    def set_fixed(self, position: Position | None) -> None:
        """The configuration was reloaded."""
        self._positions.set_fixed(position)
        self._send()

    def on_reserved_message(self, event: MessageReceived) -> None:
        """A peer's daemon sent something, perhaps its position."""
        if event.topic != POSITION_TOPIC:
            return
        position = self._positions.receive(event.source, event.payload, self._driver.now())
        if position is not None:
            self._record(event.source, position)

    def json(self) -> list[Json]:
        """Every known position, this node's first."""
        return self._positions.json(self._name, self._driver.now())

    def _send(self) -> None:
        message, own = self._positions.due(self._driver.now()), self._positions.own
        if message is not None and own is not None:
            self._driver.send(POSITION_TOPIC, message, type_name=POSITION_TYPE)
            self._record(self._name, own)

    def _record(self, name: str, position: Position) -> None:
        recorder = self._recorder()
        if recorder is not None:
            recorder.position(self._driver.now(), name, position)
