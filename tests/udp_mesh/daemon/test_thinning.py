"""A program with a maximum rate gets the newest message of each interval, of each stream, within bounded memory."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import cast

import pytest

from udp_mesh.daemon import thinning
from udp_mesh.daemon.api import Client
from udp_mesh.daemon.thinning import Thinning


class Call:
    def __init__(self, call: Callable[[], None]) -> None:
        self.call = call
        self.is_cancelled = False

    def cancel(self) -> None:
        self.is_cancelled = True


class Loop:
    """A clock that is set by hand, with timers."""

    def __init__(self) -> None:
        self.now = 100.0
        self._calls: list[tuple[float, int, Call]] = []

    def time(self) -> float:
        return self.now

    def call_at(self, at: float, call: Callable[[], None]) -> Call:
        made = Call(call)
        heapq.heappush(self._calls, (at, len(self._calls), made))
        return made

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self._calls and self._calls[0][0] <= end:
            self.now, _, made = heapq.heappop(self._calls)
            if not made.is_cancelled:
                made.call()
        self.now = end


class Program:
    def __init__(self, loop: Loop) -> None:
        self._loop = loop
        self.frames: list[tuple[float, bytes]] = []

    def send_encoded(self, frame: bytes) -> bool:
        self.frames.append((round(self._loop.now, 3), frame))
        return True


@pytest.fixture
def loop() -> Loop:
    return Loop()


def made(loop: Loop) -> tuple[Thinning, Client, list[tuple[float, bytes]]]:
    program = Program(loop)
    return Thinning(loop.time, loop.call_at), cast(Client, program), program.frames


def test_the_newest_of_each_interval_is_sent(loop: Loop) -> None:
    thinned, client, frames = made(loop)
    for turn in range(10):
        thinned.send(client, ("video", "spot"), 1.0, b"%d" % turn)
        loop.run(0.25)
    loop.run(10.0)
    assert frames == [(100.0, b"0"), (101.0, b"3"), (102.0, b"7"), (103.0, b"9")]


def test_streams_of_other_topics_and_sources_are_thinned_by_themselves(loop: Loop) -> None:
    thinned, client, frames = made(loop)
    for stream in (("video", "spot"), ("video", "husky"), ("map", "spot")):
        thinned.send(client, stream, 0.1, "/".join(stream).encode())
    assert [frame for _, frame in frames] == [b"video/spot", b"video/husky", b"map/spot"]


def test_a_higher_rate_takes_effect_at_once(loop: Loop) -> None:
    thinned, client, frames = made(loop)
    thinned.send(client, ("video", "spot"), 0.01, b"0")
    loop.run(1.0)
    thinned.send(client, ("video", "spot"), 10.0, b"1")
    loop.run(1.0)
    assert [frame for _, frame in frames] == [b"0", b"1"]


def test_a_client_that_is_gone_gets_nothing_more(loop: Loop) -> None:
    thinned, client, frames = made(loop)
    for frame in (b"0", b"1"):
        thinned.send(client, ("video", "spot"), 1.0, frame)
    thinned.remove_client(client)
    loop.run(10.0)
    assert [frame for _, frame in frames] == [b"0"]
    assert (thinned._streams, thinned._waiting_bytes, thinned._paces) == (0, 0, {})


def test_invented_streams_and_large_frames_take_bounded_memory(loop: Loop, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(thinning, "MAX_PACED", 10)
    monkeypatch.setattr(thinning, "MAX_WAITING_BYTES", 1000)
    thinned, client, frames = made(loop)
    for turn in range(50):
        for frame in (bytes(10), bytes(300)):
            thinned.send(client, ("video", f"source{turn}"), 0.1, frame)
    assert thinned._streams == 10
    assert thinned._waiting_bytes <= 1000
    # Beyond the limits, messages are passed on, not lost.
    assert len(frames) == 100 - 3
    loop.run(20.0)
    assert len(frames) == 100
    thinned.send(client, ("video", "later"), 0.1, b"")
    assert thinned._streams == 1
