"""Reconnecting unreachable nodes takes minutes, shows what it does, and ends with the first interrupt."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from meshctl.apply.reconnect import reconnect
from meshctl.device.errors import ConnectionLost
from meshctl.device.observation import Station
from meshctl.fleet import Event, EventKind, Interrupt
from meshctl.nodes.collect import FleetObservation
from meshctl.nodes.connections import ConnectionPool
from tests.meshctl.plan.support import fleet, running

MAC = "02:00:00:00:01:02"


class SilentNeighbor:
    """A connection whose script runs until the connection is closed."""

    def __init__(self) -> None:
        self.closed = threading.Event()

    def run(self, script: str, *, timeout_s: float) -> Any:
        assert self.closed.wait(60), "the connection is closed by the interrupt"
        raise ConnectionLost("b01: closed")

    def close(self) -> None:
        self.closed.set()


@pytest.mark.parametrize("when", ["before it is connected", "while it is asked"])
def test_an_interrupt_need_not_wait_for_neighbors_that_repair_their_links(when: str) -> None:
    interrupt, events, neighbor = Interrupt(), list[Event](), SilentNeighbor()

    @contextmanager
    def borrow(_node: object) -> Iterator[SilentNeighbor]:
        if when == "before it is connected":
            interrupt.request()
        yield neighbor

    def observer(event: Event) -> None:
        events.append(event)

    def run(script: str, *, timeout_s: float) -> Any:
        interrupt.request()
        return SilentNeighbor.run(neighbor, script, timeout_s=timeout_s)

    if when == "while it is asked":
        neighbor.run = run  # type: ignore[method-assign]
    heard = Station("mesh0", MAC, inactive_ms=200, connected_s=500)
    around = {"b01": replace(running(fleet(), "b01", neighbours=()), stations=(heard,))}
    seen = FleetObservation(around, {"b02": "no answer"})
    pool = cast(ConnectionPool, SimpleNamespace(borrow=borrow))
    reconnect(pool, fleet(), seen, {MAC: "b02"}, interrupt=interrupt, observer=observer)
    assert [(event.kind, event.node) for event in events] == [(EventKind.STEP, "b01"), (EventKind.FINISHED, "b01")]
    assert events[0].text.startswith("repairs its links to nodes that do not answer (at most ")
