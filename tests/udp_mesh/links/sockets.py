"""Real sockets on the loopback for tests."""

import contextlib
import random
import select
import socket
import time
from dataclasses import dataclass
from pathlib import Path

from udp_mesh.links.attachments import Address, Attachment
from udp_mesh.links.udp import UdpLink

WAIT_S = 60.0
"""Generous bound of every wait for a real part; passes as soon as the thing is true."""


@dataclass(frozen=True)
class Out:
    """A datagram to send."""

    data: bytes
    destination: Address | None
    urgent: bool = False


def free_port() -> int:
    """A port that is free now, for UDP and TCP, and below those that the kernel itself gives to connections later."""
    first, _ = Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()
    while True:
        port = random.SystemRandom().randrange(10_000, max(20_000, int(first)))
        with (
            contextlib.suppress(OSError),
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp,
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as tcp,
        ):
            udp.bind(("127.0.0.1", port))
            tcp.bind(("127.0.0.1", port))
            return port


def open_link(host: str, port: int, *, urgent_dscp: int = 0) -> UdpLink:
    return UdpLink(Attachment(host, "lo", (host, port), None, 65_535, 1), urgent_dscp=urgent_dscp)


def receive(link: UdpLink, count: int) -> list[tuple[bytes, Address]]:
    """Waits until `count` datagrams have arrived."""
    found: list[tuple[bytes, Address]] = []

    def deliver(data: memoryview, source: Address, arrived: float) -> None:
        assert abs(time.time() - arrived) < WAIT_S
        found.append((bytes(data), source))

    deadline = time.monotonic() + WAIT_S
    while len(found) < count and time.monotonic() < deadline:
        select.select([link.fileno(), link.unmarked_fileno(), link.strangers_fileno()], [], [], 1.0)
        link.receive(deliver, 1000)
        link.receive_unmarked(deliver, 1000)
        link.receive_from_strangers(deliver, 1000)
    return found
