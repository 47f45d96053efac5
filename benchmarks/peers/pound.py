"""Pound (a ROS 1 node for several masters), written from its wire behavior: its program needs ROS 1.

A message is cut into parts of 1,400 B behind a header of 36 B. One queue holds the parts of all topics; the part with
the highest priority is sent next, then the sender pauses for a fixed time. Nothing is acknowledged or sent again. A
message of more than 10,000 B is dropped when the queue is longer than `queue`; here the program waits instead.

The variant is Pound's setting `delay`, the pause in microseconds; a packet takes 1,171 us at 10 Mbit/s. Its other
setting, `rate_mbps = 10`, would pause for 1,424 us, because it accounts for the overhead of 802.11, which this link
does not have. A pause that took too long is made up for: here it is Python that oversleeps.
"""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from benchmarks.peers import PORT
from benchmarks.peers.datagrams import receiving

PART_BYTES = 1400
# part, size, message size, number, deadline, timestamp, priority, port, source, destination, parts
_HEADER = struct.Struct("<iiiiIIBBBxII")
# `queue` of its configuration
_QUEUE = 50
# what it puts around each message of a topic of std_msgs/UInt8MultiArray: sizes, checksum, type, name; no definition
_ENVELOPE = bytes(14) + b"82373f1612381bb6ee473b5cd6f5d89c" + b"std_msgs/UInt8MultiArray" + b"/bulk"
_BULK_PRIORITY, _URGENT_PRIORITY = 10, 100


def parts(data: bytes, number: int, priority: int) -> list[bytes]:
    """The datagrams of a message."""
    whole = _ENVELOPE + data
    chunks = [whole[at : at + PART_BYTES] for at in range(0, len(whole), PART_BYTES)]
    return [
        _HEADER.pack(part, len(chunk), len(whole), number, 0, 0, priority, 0, 0, 1, len(chunks)) + chunk
        for part, chunk in enumerate(chunks)
    ]


class Reassembly:
    """Messages of which parts have arrived. An incomplete one is kept, as Pound does."""

    def __init__(self) -> None:
        self._incomplete: dict[int, dict[int, bytes]] = {}

    def add(self, datagram: bytes) -> bytes | None:
        """Returns the message that this datagram completes."""
        part, _, _, number, *_, count = _HEADER.unpack_from(datagram)
        held = self._incomplete.setdefault(number, {})
        held[part] = datagram[_HEADER.size :]
        if len(held) < count:
            return None
        del self._incomplete[number]
        return b"".join(held[index] for index in range(count))[len(_ENVELOPE) :]


class _Sender:
    def __init__(self, address: str, pause_s: float) -> None:
        self._to = (address, PORT)
        self._pause_s = pause_s
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._queues: dict[int, deque[bytes]] = {_URGENT_PRIORITY: deque(), _BULK_PRIORITY: deque()}
        self._changed = threading.Condition()
        self._number = 0
        self._ended = False
        self._thread = threading.Thread(target=self._transmit)
        self._thread.start()

    async def bulk(self, data: bytes) -> None:
        while sum(map(len, self._queues.values())) > _QUEUE:  # noqa: ASYNC110
            await asyncio.sleep(0.002)
        self._push(data, _BULK_PRIORITY)

    async def urgent(self, data: bytes) -> None:
        self._push(data, _URGENT_PRIORITY)

    def _push(self, data: bytes, priority: int) -> None:
        self._number += 1
        with self._changed:
            self._queues[priority].extend(parts(data, self._number, priority))
            self._changed.notify()

    def _transmit(self) -> None:
        next_s = 0.0
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or any(self._queues.values()))
                if self._ended:
                    return
                datagram = next(queue for queue in self._queues.values() if queue).popleft()
            self._socket.sendto(datagram, self._to)
            now = time.monotonic()
            next_s = max(next_s, now - self._pause_s) + self._pause_s
            time.sleep(max(0.0, next_s - now))

    def close(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join()
        self._socket.close()


@dataclass(frozen=True, slots=True)
class _Transport:
    pause_s: float

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_Sender]:
        sender = _Sender(address, self.pause_s)
        try:
            yield sender
        finally:
            sender.close()

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        async with receiving(PORT, Reassembly().add, on_message):
            yield


def transport(variant: str) -> _Transport:
    return _Transport(float(variant) / 1e6)
