"""CPU cost of waking up for a datagram: processes that only receive, one datagram at a time, as from a 10 Mbit/s link.
The minimum for any receiver in Python.

    python -m benchmarks.wake_up [--fill]
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import os
import resource
import socket
import time
from collections.abc import Callable

from benchmarks.page import fill
from benchmarks.tables import row

DATAGRAMS_PER_S = 900
DATAGRAM_BYTES = 1430
SECONDS = 8.0
# below this the sender slept too long, which would make the receiver look cheaper
_MIN_SENT_SHARE = 0.95
_BUFFER_BYTES = 1 << 16
_ANCILLARY_BYTES = 256


def _send(port: int) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as sender:
        sender.connect(("127.0.0.1", port))
        data, at = os.urandom(DATAGRAM_BYTES), time.monotonic()
        while True:
            at += 1 / DATAGRAMS_PER_S
            time.sleep(max(0.0, at - time.monotonic()))
            sender.send(data)


def waiting(receiver: socket.socket) -> int:
    """Receive with one blocking system call per datagram; returns their number."""
    buffer, count = bytearray(_BUFFER_BYTES), 0
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        receiver.recvfrom_into(buffer)
        count += 1
    return count


def in_a_loop(receiver: socket.socket) -> int:
    """Receive with asyncio, which reads until the socket is empty; returns their number."""
    buffer, count = bytearray(_BUFFER_BYTES), 0
    receiver.setblocking(False)

    def readable() -> None:
        nonlocal count
        while True:
            try:
                receiver.recvmsg_into([buffer], _ANCILLARY_BYTES)
            except BlockingIOError:
                return
            count += 1

    async def run() -> None:
        asyncio.get_running_loop().add_reader(receiver.fileno(), readable)
        await asyncio.sleep(SECONDS)

    asyncio.run(run())
    return count


def cores(receive: Callable[[socket.socket], int]) -> tuple[float, float]:
    """(share of a core, microseconds per datagram) of this process."""
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        sender = multiprocessing.Process(target=_send, args=(receiver.getsockname()[1],), daemon=True)
        sender.start()
        try:
            before, began = resource.getrusage(resource.RUSAGE_SELF), time.monotonic()
            count = receive(receiver)
            after, took_s = resource.getrusage(resource.RUSAGE_SELF), time.monotonic() - began
        finally:
            sender.terminate()
            sender.join()
    if count < _MIN_SENT_SHARE * DATAGRAMS_PER_S * SECONDS:
        raise RuntimeError(
            f"expected {DATAGRAMS_PER_S} datagrams a second, found {count / took_s:.0f}; is the machine busy?"
        )
    cpu_s = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return cpu_s / took_s, cpu_s / count * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wake_up", description=__doc__)
    parser.add_argument("--fill", action="store_true", help="write the table to docs/benchmarks.md")
    arguments = parser.parse_args()
    lines = [row(["receives by", "cores", "us per datagram"]), row(["---"] * 3)]
    for name, receive in (("a call that waits", waiting), ("asyncio, reading until nothing is left", in_a_loop)):
        share, each_us = cores(receive)
        lines.append(row([name, f"{share:.3f}", f"{each_us:.0f}"]))
    text = "\n".join(lines)
    print(text)
    if arguments.fill:
        fill("wake-up", text)


if __name__ == "__main__":
    main()
