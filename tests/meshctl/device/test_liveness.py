"""The stream below an SSH connection: hundreds of idle ones cost little, and closing one wakes its reader."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

from meshctl.device.liveness import ActivityStream


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
