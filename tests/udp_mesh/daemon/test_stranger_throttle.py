"""A flood from strangers is read a few datagrams at a time, with pauses; what is no flood is read as before."""

from __future__ import annotations

import asyncio
from contextlib import closing
from typing import cast

import pytest

from tests.udp_mesh.daemon.test_bulk_ticks import ManualLoop
from tests.udp_mesh.links.sockets import free_port, open_link
from udp_mesh.daemon.stranger_throttle import (
    FLOOD_BATCH,
    FLOOD_DATAGRAMS,
    MAX_PAUSE_S,
    MIN_PAUSE_S,
    PAUSE,
    StrangerThrottle,
)
from udp_mesh.links.udp import UdpLink

BATCH = 256
READ_S = 0.01


class Strangers:
    """As many datagrams wait as are read; `forged` of each read prove to come from no peer."""

    def __init__(self, link: UdpLink) -> None:
        self.loop = ManualLoop()
        self.limits: list[int] = []
        self.waiting, self.forged, self.unauthenticated = 1000, 1.0, 0
        self.read_s = READ_S
        loop = cast("asyncio.AbstractEventLoop", self.loop)
        self.throttle = StrangerThrottle(loop, self._read, lambda: self.unauthenticated, batch=BATCH)
        self.throttle.watch(link)

    def _read(self, _: UdpLink, limit: int) -> int:
        self.loop.now += self.read_s
        self.limits.append(limit)
        count = min(limit, self.waiting)
        self.unauthenticated += int(self.forged * count)
        return count

    def wake(self) -> None:
        """The socket is readable."""
        (readable,) = self.loop.readers.values()
        readable()

    def end_pause(self) -> float:
        """How long nothing was read."""
        timer = self.loop.timer
        assert timer is not None
        assert not self.loop.readers
        paused_s, self.loop.timer = timer.when() - self.loop.now, None
        timer._run()
        return paused_s


def test_a_flood_is_read_in_small_batches_for_a_fifth_of_the_time() -> None:
    with closing(open_link("127.0.1.4", free_port())) as link:
        strangers = Strangers(link)
        for _ in range(3):
            strangers.wake()
            assert strangers.throttle.paused
            assert strangers.end_pause() == pytest.approx(max(MIN_PAUSE_S, PAUSE * READ_S))
        assert strangers.limits == [BATCH, FLOOD_BATCH, FLOOD_BATCH]
        strangers.forged = 0.0
        strangers.wake()
        strangers.wake()
        assert strangers.limits[3:] == [FLOOD_BATCH, BATCH]


def test_after_a_process_was_suspended_strangers_are_heard_soon() -> None:
    """The time of the suspension was taken for what reading had cost: new robots were not heard for minutes."""
    with closing(open_link("127.0.1.4", free_port())) as link:
        strangers = Strangers(link)
        strangers.read_s = 30.0
        strangers.wake()
        assert strangers.end_pause() == pytest.approx(MAX_PAUSE_S)


@pytest.mark.parametrize(("waiting", "forged"), [(FLOOD_DATAGRAMS - 1, 1.0), (1000, 0.5)])
def test_few_forged_datagrams_or_as_many_authentic_ones_are_no_flood(waiting: int, forged: float) -> None:
    with closing(open_link("127.0.1.4", free_port())) as link:
        strangers = Strangers(link)
        strangers.waiting, strangers.forged = waiting, forged
        strangers.wake()
        assert not strangers.throttle.paused
        strangers.wake()
        assert strangers.limits == [BATCH, BATCH]
