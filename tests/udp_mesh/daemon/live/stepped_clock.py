"""A daemon whose wall clock is set while it runs, on a computer that may be busy:
`python -m tests.udp_mesh.daemon.live.stepped_clock CLOCK run FILE`.

The host's clock cannot be set for one process alone. Here `time.time` and the kernel's timestamps of datagrams are
moved by the last line of the file CLOCK, in seconds. What arrived before that line was written has the offset before
it, as after settimeofday(2). With SMALL_BUFFERS in the environment, the sockets hold a few datagrams only. While the
file CLOCK.refused exists, the kernel refuses some datagrams with the errors that it names, such as `ENOBUFS EAGAIN`.
While CLOCK.busy exists, turns of the event loop come late. The file CLOCK.turns has the number of turns so far.
"""

from __future__ import annotations

import errno
import mmap
import os
import random
import selectors
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from udp_mesh.cli import main as command
from udp_mesh.links import udp
from udp_mesh.links.attachments import Address

SMALL_BUFFER_BYTES = 8192
"""The kernel doubles it and counts its own overhead: about ten full datagrams."""
REFUSED_SHARE = 0.3
LATE_S = (0.0, 0.0, 0.001, 0.02, 0.3)
"""A turn of a busy computer's event loop comes so late."""
TURNS_BYTES = 8
_real_time = time.time


class RefusingSocket:
    """Takes the place of a socket for one call."""

    def __init__(self, number: int) -> None:
        self._error = OSError(number, os.strerror(number))

    def sendto(self, *_: object) -> int:
        raise self._error

    sendmsg = sendto


class SteppedClock:
    """The offset now, and the one before it. Reads the file when that has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = 0
        self._before_s = self._now_s = self._since_s = 0.0

    def offset_s(self, at_s: float | None = None) -> float:
        """What to add to a real time of recent arrival; by default, to the time now."""
        size = self._path.stat().st_size
        if size != self._size:
            self._size = size
            self._before_s, self._since_s = self._now_s, _real_time()
            self._now_s = float(self._path.read_text().split()[-1])
        return self._now_s if at_s is None or at_s >= self._since_s else self._before_s

    def time(self) -> float:
        return _real_time() + self.offset_s()


def watch_turns(turns_file: Path, busy_file: Path, rng: random.Random) -> None:
    """Count the turns of the event loop, and let them come late while the second file exists."""
    turns_file.write_bytes(bytes(TURNS_BYTES))
    with turns_file.open("r+b") as file:
        counter = mmap.mmap(file.fileno(), TURNS_BYTES)
    select = selectors.EpollSelector.select
    turns = 0

    def watched(self: selectors.EpollSelector, timeout: float | None = None) -> list[tuple[selectors.SelectorKey, int]]:
        nonlocal turns
        turns += 1
        counter[:] = turns.to_bytes(TURNS_BYTES, "little")
        found = select(self, timeout)
        if busy_file.exists() and (late_s := rng.choice(LATE_S)):
            time.sleep(late_s)
            # What became ready meanwhile.
            found = select(self, 0)
        return found

    selectors.EpollSelector.select = watched  # type: ignore[assignment, method-assign]


def main() -> int:
    clock_file = Path(sys.argv.pop(1))
    clock = SteppedClock(clock_file)
    refused = clock_file.with_suffix(".refused")
    receive, send_run = udp.UdpLink._receive, udp.UdpLink._send_run
    rng = random.Random(str(clock_file))

    def received(self: udp.UdpLink, from_socket: object, deliver: udp.Deliver, limit: int, stop_after: float) -> int:
        def moved(data: memoryview, source: Address, arrived: float) -> None:
            deliver(data, source, arrived + clock.offset_s(arrived) if arrived else 0.0)

        return receive(self, from_socket, moved, limit, stop_after - clock.offset_s())  # type: ignore[arg-type]

    def sent(self: udp.UdpLink, run: Sequence[udp.OutgoingDatagram], destination: Address) -> int | None:
        if not refused.exists() or rng.random() >= REFUSED_SHARE:
            return send_run(self, run, destination)
        names = refused.read_text().split() if refused.exists() else []
        real, refusing = self._socket, RefusingSocket(getattr(errno, rng.choice(names or ["EAGAIN"])))
        self._socket = refusing  # type: ignore[assignment]
        try:
            return send_run(self, run, destination)
        finally:
            self._socket = real

    if "SMALL_BUFFERS" in os.environ:
        udp.RECEIVE_BUFFER_BYTES = udp.STRANGERS_BUFFER_BYTES = udp.SEND_BUFFER_BYTES = SMALL_BUFFER_BYTES
    watch_turns(clock_file.with_suffix(".turns"), clock_file.with_suffix(".busy"), rng)
    time.time = clock.time
    udp.UdpLink._receive = received  # type: ignore[method-assign]
    udp.UdpLink._send_run = sent  # type: ignore[method-assign]
    return command.main()


if __name__ == "__main__":
    sys.exit(main())
