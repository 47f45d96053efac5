"""The topic transport of nimbro_network (ROS 1), written from its wire behavior: its programs need ROS 1 and OpenFEC.

UDP with forward error correction, `fec F`: a message becomes symbols of up to 1,428 B behind a header of 16 B, and F
times as many repair symbols, sent at once and in random order; nothing is acknowledged or sent again. The sender's
`rate` of the bulk topic is set so that its datagrams take 93 % of 10 Mbit/s. The receiver keeps the newest 31
messages.

TCP, `tcp`: the sender waits for one byte of acknowledgment after each message. The bulk topic, which must arrive,
goes there, and the urgent one over UDP with `fec 0.5`, which is how its documentation divides topics between the two.
"""

from __future__ import annotations

import asyncio
import math
import random
import socket
import struct
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from benchmarks.peers import PORT
from benchmarks.peers.datagrams import receiving
from benchmarks.peers.erasure_code import repair_symbols, source_symbols

# message, symbol, symbol length, source symbols, repair symbols, seed
_HEADER = struct.Struct("<HIHHHI")
_DATAGRAM_BYTES = 1444
SYMBOL_BYTES = _DATAGRAM_BYTES - _HEADER.size
# topic name, type, checksum, flags, counter; here also the length, which ROS's serialization holds
_TOPIC = struct.Struct("<64s64s16sHHI")
_KEPT_MESSAGES = 31
_BITS_PER_S = 9.3e6
_IP_UDP_BYTES = 28
# lengths of the topic's name and type, of the data, checksum, flags
_TCP_HEADER = struct.Struct("<HHI16sI")
_URGENT_FEC = 0.5
_MD5 = bytes.fromhex("82373f1612381bb6ee473b5cd6f5d89c")
_TYPE = b"std_msgs/UInt8MultiArray"


def datagrams(data: bytes, number: int, topic: bytes, fec: float, chance: random.Random) -> list[bytes]:
    """A message with its repair symbols, in random order."""
    whole = _TOPIC.pack(topic, _TYPE, _MD5, 0, number & 0xFFFF, len(data)) + data
    size = min(SYMBOL_BYTES, len(whole))
    sources = [whole[at : at + size].ljust(size, b"\0") for at in range(0, len(whole), size)]
    repairs = math.ceil(fec * len(sources))
    symbols = [*sources, *repair_symbols(sources, repairs)]
    made = [
        _HEADER.pack(number & 0xFFFF, index, size, len(sources), repairs, 0) + symbol
        for index, symbol in enumerate(symbols)
    ]
    chance.shuffle(made)
    return made


class Reassembly:
    """The newest messages of which symbols have arrived."""

    def __init__(self) -> None:
        self._held: dict[int, dict[int, bytes] | None] = {}

    def add(self, datagram: bytes) -> bytes | None:
        """Returns the message that this datagram completes."""
        number, index, _, count, _, _ = _HEADER.unpack_from(datagram)
        if number not in self._held:
            self._held[number] = {}
            while len(self._held) > _KEPT_MESSAGES:
                del self._held[next(iter(self._held))]
        symbols = self._held[number]
        if symbols is None:
            return None
        symbols[index] = datagram[_HEADER.size :]
        if len(symbols) < count:
            return None
        whole = b"".join(source_symbols(symbols, count))
        # complete: its other symbols are of no use
        self._held[number] = None
        *_, length = _TOPIC.unpack_from(whole)
        return whole[_TOPIC.size : _TOPIC.size + length]


class _UdpSender:
    def __init__(self, address: str, fec: float) -> None:
        self._fec = fec
        self._socket = socket.socket(type=socket.SOCK_DGRAM)
        self._socket.connect((address, PORT))
        self._number = 0
        self._chance = random.Random(1)
        self._next_bulk_s = 0.0

    async def bulk(self, data: bytes) -> None:
        await asyncio.sleep(max(0.0, self._next_bulk_s - time.monotonic()))
        now = time.monotonic()
        size = self._send(data, b"/bulk")
        self._next_bulk_s = max(now - 0.01, self._next_bulk_s) + size * 8 / _BITS_PER_S

    async def urgent(self, data: bytes) -> None:
        self._send(data, b"/urgent")

    def _send(self, data: bytes, topic: bytes) -> int:
        """Returns the bytes of IP that this takes."""
        self._number += 1
        made = datagrams(data, self._number, topic, self._fec, self._chance)
        for datagram in made:
            self._socket.send(datagram)
        return sum(len(datagram) + _IP_UDP_BYTES for datagram in made)

    def close(self) -> None:
        self._socket.close()


class _TcpSender:
    """Bulk over TCP, urgent messages over UDP."""

    def __init__(self, streams: tuple[asyncio.StreamReader, asyncio.StreamWriter], urgent: _UdpSender) -> None:
        self._reader, self._writer = streams
        self.urgent = urgent.urgent

    async def bulk(self, data: bytes) -> None:
        topic = b"/bulk"
        self._writer.write(_TCP_HEADER.pack(len(topic), len(_TYPE), len(data), _MD5, 0) + topic + _TYPE + data)
        await self._reader.readexactly(1)


@dataclass(frozen=True, slots=True)
class _Transport:
    fec: float
    uses_tcp: bool

    @asynccontextmanager
    async def sender(self, address: str) -> AsyncIterator[_UdpSender | _TcpSender]:
        datagram_sender = _UdpSender(address, self.fec)
        try:
            if not self.uses_tcp:
                yield datagram_sender
                return
            streams = await asyncio.open_connection(address, PORT)
            try:
                yield _TcpSender(streams, datagram_sender)
            finally:
                streams[1].transport.abort()
        finally:
            datagram_sender.close()

    @asynccontextmanager
    async def receiver(self, on_message: Callable[[bytes], None]) -> AsyncIterator[None]:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                while True:
                    topic, kind, size, _, _ = _TCP_HEADER.unpack(await reader.readexactly(_TCP_HEADER.size))
                    await reader.readexactly(topic + kind)
                    on_message(await reader.readexactly(size))
                    writer.write(b"\x01")
            except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
                # the sender has ended, or this end is closing
                writer.transport.abort()

        datagrams_received = receiving(PORT, Reassembly().add, on_message)
        async with datagrams_received, await asyncio.start_server(serve, port=PORT, limit=1 << 20):
            yield


def transport(variant: str) -> _Transport:
    if variant == "tcp":
        return _Transport(_URGENT_FEC, True)
    return _Transport(float(variant.removeprefix("fec ")), False)
