"""The stream below an SSH connection and its watchdogs: hundreds of them cost little; closing one wakes its reader."""

from __future__ import annotations

import socket
import threading
import time
import weakref
from contextlib import ExitStack, suppress
from typing import cast

import paramiko
import pytest

from meshctl.device.liveness import MAX_ENDED_WATCHDOGS, MAX_OWN_PAUSE_S, ActivityStream, Watchdog


def test_short_read_timeouts_are_raised_to_the_poll_interval() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        stream = ActivityStream(ours, poll_s=2.0)
        stream.settimeout(0.1)
        assert ours.gettimeout() == 2.0
        stream.settimeout(5.0)
        assert ours.gettimeout() == 5.0


def test_closing_wakes_the_reader_at_once() -> None:
    ours, theirs = socket.socketpair()
    with theirs:
        stream = ActivityStream(ours, poll_s=300.0)
        stream.settimeout(0.1)
        is_reading = threading.Event()

        def read() -> None:
            # the end of the stream, or a closed descriptor if it was closed before the next call
            with suppress(OSError):
                while stream.recv(1):
                    is_reading.set()

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        theirs.send(b"x")
        assert is_reading.wait(60)
        stream.close()
        reader.join(60)
        assert not reader.is_alive()


def test_a_stream_closed_by_the_peer_can_be_closed() -> None:
    ours, theirs = socket.socketpair()
    theirs.close()
    ActivityStream(ours).close()
    assert ours.fileno() == -1


class _CountedSocket(socket.socket):
    """Counts the calls of `recv`."""

    reads = 0

    def recv(self, count: int, flags: int = 0, /) -> bytes:
        self.reads += 1
        return super().recv(count, flags)


def test_what_has_arrived_is_read_at_once() -> None:
    ours, theirs = socket.socketpair()
    with theirs, _CountedSocket(fileno=ours.detach()) as counted:
        counts: list[int] = []
        stream = ActivityStream(counted, count=counts.append)
        theirs.sendall(b"0123456789")
        assert [stream.recv(4), stream.recv(4), stream.recv(4)] == [b"0123", b"4567", b"89"]
        assert (counted.reads, counts) == (1, [10])
        theirs.close()
        assert stream.recv(4) == b""


class _Transport:
    """Stands in for paramiko's: only closes."""

    def __init__(self) -> None:
        self.closed = threading.Event()

    def close(self) -> None:
        self.closed.set()

    def watched(self, seconds: float, activity: ActivityStream | None = None, silence_s: float = 0.0) -> Watchdog:
        return Watchdog(cast(paramiko.Transport, self), seconds, activity=activity, silence_s=silence_s)


def test_all_watchdogs_share_one_thread() -> None:
    with _Transport().watched(3600):
        before = set(threading.enumerate())
        with ExitStack() as stack:
            for _ in range(100):
                stack.enter_context(_Transport().watched(3600))
            assert set(threading.enumerate()) <= before
    assert [thread.name for thread in threading.enumerate()].count("watchdogs") == 1


def test_a_watchdog_closes_its_own_transport_only() -> None:
    late, other = _Transport(), _Transport()
    with other.watched(3600) as patient, late.watched(0.01) as watchdog:
        assert late.closed.wait(60)
    assert (watchdog.timed_out, watchdog.silent) == (True, False)
    assert not patient.timed_out
    assert not other.closed.is_set()


def test_a_watchdog_is_checked_again_when_its_limit_or_the_silence_is_due() -> None:
    ours, theirs = socket.socketpair()
    with ours, theirs:
        activity = ActivityStream(ours)
        with _Transport().watched(1000, activity, silence_s=100) as watchdog:
            began_s = time.monotonic()
            activity.last_received_s = began_s + 50
            assert watchdog.check(began_s + 60) == pytest.approx(began_s + 150)
            # our own process may have slept
            assert watchdog.check(began_s + 150.1) == pytest.approx(began_s + 150.1 + MAX_OWN_PAUSE_S)
            assert not watchdog.silent
            assert watchdog.check(began_s + 150.1 + MAX_OWN_PAUSE_S) is None
            assert (watchdog.silent, watchdog.timed_out) == (True, False)
            assert watchdog.check(began_s + 1000) is None
            assert watchdog.timed_out


def test_ended_watchdogs_are_forgotten() -> None:
    first = _Transport()
    gone = weakref.ref(first)
    with first.watched(3600):
        pass
    del first
    running = threading.active_count()
    for _ in range(4 * (MAX_ENDED_WATCHDOGS + running)):
        with _Transport().watched(3600):
            pass
    assert gone() is None
