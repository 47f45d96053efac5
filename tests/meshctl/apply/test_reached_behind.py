"""A relay that rebooted in its change reaches the nodes behind it, which drop its frames until its numbers catch up."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import reconnect
from meshctl.device.observation import Observation, Station
from meshctl.fleet import Interrupt
from meshctl.plan.radios import NO_RADIOS
from tests.meshctl.apply.mesh_nodes import MACS, node
from tests.meshctl.apply.test_station_flush import Neighbors

BEHIND = MACS["b03"]


class Chain(Neighbors):
    """b01 - b02 - b03, where b02 has rebooted and b03 drops what it sends until it has sent enough."""

    def __init__(self) -> None:
        super().__init__({"b02": node("b02", "b01", "b03"), "b01": node("b01", "b02"), "b03": node("b03", "b02")})
        self.silent = {"b03"}
        self.sent: list[str] = []
        work = cast("SimpleNamespace", self.work)
        work.interrupt = Interrupt()
        work.observer = lambda _: None
        work.note = lambda text, name="": self.notes.append(text if not name else f"{name}: {text}")
        work.connections.borrow = self._borrow
        work.connections.former_places = dict

    @contextmanager
    def _borrow(self, there: SimpleNamespace) -> Iterator[SimpleNamespace]:
        def run(script: str, *, timeout_s: float) -> SimpleNamespace:
            self.sent += [line for line in script.splitlines() if line.startswith("catch_up ")]
            self.silent.clear()
            return SimpleNamespace(stdout=f"caught-up {BEHIND}\n")

        assert there.name == "b02"
        yield SimpleNamespace(run=run)


def after_the_boot(*, inactive_ms: int) -> Observation:
    stations = (Station("mesh0", BEHIND, connected_s=9, inactive_ms=inactive_ms),)
    return replace(node("b02"), stations=stations)


@pytest.mark.parametrize("rebooted", [True, False])
def test_a_relay_that_rebooted_in_a_change_of_packages_reaches_the_node_behind_it(rebooted: bool) -> None:
    """Before, the nodes behind it, which come next, were unreachable until the following run."""
    chain = Chain()
    flush = chain.flushes.listener(chain.job, NO_RADIOS)
    flush.started()
    flush.ended(after_the_boot(inactive_ms=100), went_back=True, rebooted=rebooted)
    if not rebooted:
        assert (chain.asked, chain.sent) == ([], [])
        return
    assert chain.sent == [f"catch_up mesh0 {BEHIND}"]
    assert "b03" in chain.names
    assert chain.notes[-1] == "b02: b03 removed a stale entry of its radio"
    assert chain.flushes.retry_unanswered(chain.work) == {}


def test_it_sends_nothing_to_a_node_that_it_does_not_hear() -> None:
    chain = Chain()
    flush = chain.flushes.listener(chain.job, NO_RADIOS)
    flush.started()
    flush.ended(after_the_boot(inactive_ms=reconnect.HEARD_MS), went_back=True, rebooted=True)
    assert chain.sent == []
    assert chain.flushes.retry_unanswered(chain.work) == {"b02": ("b03",)}


def test_an_operator_who_leaves_does_not_wait_for_it() -> None:
    chain = Chain()
    flush = chain.flushes.listener(chain.job, NO_RADIOS)
    flush.started()
    chain.work.interrupt.request()
    flush.ended(after_the_boot(inactive_ms=100), went_back=True, rebooted=True)
    assert chain.sent == []
