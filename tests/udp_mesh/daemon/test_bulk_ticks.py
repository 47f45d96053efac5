"""What is not urgent is read in ticks only while it arrives often, marks arrive, and acknowledgments are not late."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any, cast

import pytest

from tests.udp_mesh.links.sockets import free_port, open_link
from udp_mesh.daemon.bulk_ticks import LATE_EXCESS, MARKED_VALID_S, MAX_DATAGRAMS, PAUSE_S, TICK_S, BulkTicks
from udp_mesh.links.udp import UdpLink


class ManualLoop:
    """A loop with a clock that the test sets."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.readers: dict[int, Callable[[], object]] = {}
        self.timer: asyncio.TimerHandle | None = None

    def time(self) -> float:
        return self.now

    def get_debug(self) -> bool:
        return False

    def add_reader(self, fd: Any, callback: Any, *args: Any) -> None:
        self.readers[fd] = lambda: callback(*args)

    def remove_reader(self, fd: Any) -> bool:
        return self.readers.pop(fd, None) is not None

    def call_at(self, when: float, callback: Any, *args: Any, context: Any = None) -> asyncio.TimerHandle:
        self.timer = asyncio.TimerHandle(when, callback, args, cast("asyncio.AbstractEventLoop", self), context)
        return self.timer

    def _timer_handle_cancelled(self, handle: asyncio.TimerHandle) -> None:
        assert handle is self.timer
        self.timer = None


class _Reading:
    """Counts reads; `waiting` datagrams are read at the next one."""

    def __init__(self, link: UdpLink) -> None:
        self.link = link
        self.loop = ManualLoop()
        self.late_acknowledgements = 0
        loop = cast("asyncio.AbstractEventLoop", self.loop)
        self.ticks = BulkTicks(loop, self, self._read, self._after_read)
        self.waiting = 0
        self.reads = self.after_reads = 0
        self.ticks.watch(link)
        self.ticks.marked_arrived(link, self.loop.now)

    def _read(self, link: UdpLink) -> int:
        assert link is self.link
        self.reads += 1
        count, self.waiting = self.waiting, 0
        return count

    def _after_read(self) -> None:
        self.after_reads += 1

    def is_watched(self) -> bool:
        return self.link.unmarked_fileno() in self.loop.readers

    def arrive(self, after_s: float) -> None:
        """A datagram arrives; the loop calls the reader if it watches the socket."""
        self.loop.now += after_s
        self.waiting += 1
        if self.is_watched():
            self.loop.readers[self.link.unmarked_fileno()]()

    def tick(self) -> None:
        handle, self.loop.timer = self.loop.timer, None
        assert handle is not None
        self.loop.now = max(self.loop.now, handle.when())
        handle._run()


@pytest.fixture
def reading() -> Iterator[_Reading]:
    with closing(open_link("127.0.1.2", free_port())) as link:
        yield _Reading(link)


def test_datagrams_that_arrive_often_are_read_in_ticks_until_they_get_fewer(reading: _Reading) -> None:
    reading.arrive(1.0)
    assert reading.is_watched()
    reading.arrive(0.001)
    assert not reading.is_watched()
    for _ in range(3):
        reads = reading.reads
        for _ in range(3):
            reading.arrive(0.001)
        assert reading.reads == reads
        reading.tick()
        assert (reading.waiting, reading.reads, reading.is_watched()) == (0, reads + 1, False)
    assert reading.after_reads == 5
    reading.arrive(0.001)
    reading.tick()
    assert reading.is_watched()
    assert reading.loop.timer is None
    assert (reading.waiting, reading.after_reads) == (0, 6)


def test_datagrams_further_apart_are_read_at_once(reading: _Reading) -> None:
    for _ in range(10):
        reading.arrive(TICK_S * 0.75)
        assert reading.waiting == 0
    assert reading.is_watched()


def test_datagrams_read_between_ticks_keep_the_ticks_going(reading: _Reading) -> None:
    reading.arrive(1.0)
    reading.arrive(0.001)
    for _ in range(3):
        reading.arrive(0.001)
        reading.ticks.read_ticking()
        assert reading.waiting == 0
    reading.tick()
    assert not reading.is_watched()


def test_without_marks_nothing_waits_for_a_tick(reading: _Reading) -> None:
    reading.loop.now += MARKED_VALID_S
    for _ in range(10):
        reading.arrive(0.001)
        assert reading.waiting == 0
    reading.ticks.marked_arrived(reading.link, reading.loop.now)
    reading.arrive(0.001)
    assert not reading.is_watched()
    # The marks end: so do the ticks.
    reading.loop.now += MARKED_VALID_S
    reading.waiting = 10
    reading.tick()
    assert reading.is_watched()


def test_a_fast_stream_is_read_at_once(reading: _Reading) -> None:
    reading.arrive(1.0)
    reading.arrive(0.001)
    reading.waiting = MAX_DATAGRAMS
    reading.tick()
    assert not reading.is_watched()
    reading.waiting = MAX_DATAGRAMS + 1
    reading.tick()
    assert reading.is_watched()
    reading.arrive(0.0001)
    reading.arrive(0.0001)
    assert reading.is_watched()


def ticks_until_watched(reading: _Reading, *, late_every: int) -> int | None:
    """How many ticks follow if every so many have a late acknowledgment (None: ticks go on)."""
    reading.arrive(1.0)
    reading.arrive(0.001)
    for number in range(1, 200):
        reading.waiting = 4
        reading.late_acknowledgements += number % late_every == 0
        reading.ticks.marked_arrived(reading.link, reading.loop.now)
        reading.tick()
        if reading.is_watched():
            return number
    return None


def test_a_path_too_short_for_ticks_is_soon_read_at_once_again(reading: _Reading) -> None:
    number = ticks_until_watched(reading, late_every=1)
    assert number is not None
    assert number < 2 * LATE_EXCESS + 1
    for _ in range(100):
        reading.arrive(0.001)
        assert reading.waiting == 0
    reading.loop.now += PAUSE_S
    reading.ticks.marked_arrived(reading.link, reading.loop.now)
    reading.arrive(0.001)
    reading.arrive(0.001)
    assert not reading.is_watched()


def test_a_few_late_acknowledgments_do_not_end_the_ticks(reading: _Reading) -> None:
    assert ticks_until_watched(reading, late_every=5) is None


def test_a_link_that_closes_has_no_ticks(reading: _Reading) -> None:
    reading.arrive(1.0)
    reading.arrive(0.001)
    reading.ticks.unwatch(reading.link)
    assert reading.loop.timer is None
    assert not reading.is_watched()
    reads = reading.reads
    reading.ticks.read_ticking()
    assert reading.reads == reads
    reading.ticks.watch(reading.link)
    assert reading.is_watched()
