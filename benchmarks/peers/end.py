"""One end of a trial, a separate process in a laboratory's host.

usage: python -m benchmarks.peers.end receive PEER RESULT SECONDS BULK_BYTES
       python -m benchmarks.peers.end send PEER ADDRESS RESULT SECONDS BULK_BYTES URGENT_HZ

Each prints `ready`, the sender once it is connected, and waits for a line on its standard input. The receiver then
records every message's arrival until SECONDS have passed, or BULK_BYTES (> 0) of bulk have arrived. The sender sends
bulk (BULK_BYTES in all; 0 none, -1 without end) and URGENT_HZ urgent messages a second. Each writes RESULT as JSON.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import resource
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import peers
from benchmarks.peers import message

# the time for the last acknowledgments to be sent after the bulk
_LINGER_S = 0.2


def cpu_s() -> float:
    """Of this process and of the processes that its main thread started."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    total = used.ru_utime + used.ru_stime
    for child in Path(f"/proc/self/task/{os.getpid()}/children").read_text().split():
        # it may end now
        with contextlib.suppress(FileNotFoundError):
            # user and system time after the name, which may contain spaces
            fields = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


def say_ready() -> None:
    sys.stdout.write("ready\n")
    sys.stdout.flush()


async def receive(name: str, result: Path, seconds: float, bulk_bytes: int) -> None:
    bulk: list[tuple[float, int]] = []
    urgent: list[tuple[int, float, float]] = []
    first_sent_s: list[float] = []
    done = asyncio.Event()
    loop = asyncio.get_running_loop()

    def on_message(data: bytes) -> None:
        seen = message.decode(data)
        now = time.monotonic()
        if seen.kind == message.URGENT:
            urgent.append((seen.number, seen.sent_s, now))
            return
        if not bulk:
            first_sent_s.append(seen.sent_s)
        bulk.append((now, (bulk[-1][1] if bulk else 0) + seen.size))
        if 0 < bulk_bytes <= bulk[-1][1]:
            # some transports call from their own thread
            loop.call_soon_threadsafe(done.set)

    async with peers.transport(name).receiver(on_message):
        say_ready()
        await asyncio.to_thread(sys.stdin.readline)
        started_cpu_s = cpu_s()
        try:
            await asyncio.wait_for(done.wait(), seconds)
            await asyncio.sleep(_LINGER_S)
        except TimeoutError:
            # time is up: the messages so far are the result
            done.set()
        write(result, bulk=bulk, urgent=urgent, first_sent_s=first_sent_s, cpu_s=cpu_s() - started_cpu_s)


async def send(name: str, address: str, result: Path, seconds: float, bulk_bytes: int, urgent_hz: float) -> None:
    async with peers.transport(name).sender(address) as sender:
        say_ready()
        await asyncio.to_thread(sys.stdin.readline)
        started_cpu_s, started_s = cpu_s(), time.monotonic()

        async def send_bulk() -> None:
            count = bulk_bytes // message.BULK_BYTES
            number = 0
            while bulk_bytes < 0 or number < count:
                await sender.bulk(message.encode(message.BULK, number, time.monotonic(), message.BULK_BYTES))
                number += 1

        async def send_urgent() -> None:
            number = 0
            while urgent_hz:
                due_s = started_s + number / urgent_hz
                await asyncio.sleep(max(0.0, due_s - time.monotonic()))
                await sender.urgent(message.encode(message.URGENT, number, time.monotonic(), message.URGENT_BYTES))
                number += 1

        tasks = [asyncio.create_task(send_bulk()), asyncio.create_task(send_urgent())]
        await asyncio.sleep(seconds)
        for task in tasks:
            task.cancel()
        outcomes = await asyncio.gather(*tasks, return_exceptions=True)
        errors = [repr(o) for o in outcomes if o is not None and not isinstance(o, asyncio.CancelledError)]
        write(result, cpu_s=cpu_s() - started_cpu_s, started_s=started_s, errors=errors)


def write(result: Path, **what: Any) -> None:
    unfinished = result.with_suffix(".part")
    unfinished.write_text(json.dumps(what))
    unfinished.rename(result)


def main(role: str, name: str, *rest: str) -> None:
    if role == "receive":
        path, seconds, bulk_bytes = rest
        asyncio.run(receive(name, Path(path), float(seconds), int(bulk_bytes)))
    else:
        address, path, seconds, bulk_bytes, urgent_hz = rest
        asyncio.run(send(name, address, Path(path), float(seconds), int(bulk_bytes), float(urgent_hz)))


if __name__ == "__main__":
    main(*sys.argv[1:])
