"""A hostile network in user space: every Ethernet frame between namespaces passes through `Ether`.

Each port is one end of a veth pair, read and written as raw frames; its other end is the only interface of a robot. Per
direction, a path loses, delays, reorders, duplicates, damages, truncates or swallows large datagrams; a channel shared
by all has a rate and a queue. A port can be behind a NAT, and recorded datagrams can be sent again, from anywhere.
"""

from __future__ import annotations

import contextlib
import heapq
import random
import select
import socket
import struct
import threading
import time
from collections import Counter, deque
from dataclasses import dataclass, field

ETH_P_ALL = 0x0003
IPV4, ARP, IPV6 = b"\x08\x00", b"\x08\x06", b"\x86\xdd"
"""Ethertypes."""
PACKET_OUTGOING = 4
IP_START, IPV4_BYTES, IPV6_BYTES, UDP_BYTES = 14, 20, 40, 8
SOURCE = {IPV4: (IP_START + 12, 4), IPV6: (IP_START + 8, 16)}
"""Offset and length of the source's address."""
PORT = 8700
MAX_QUEUE_S = 0.25
"""Of the channel: what would wait longer is dropped."""
RECORDED = 400
ICMP_ERRORS = ((0, 0), (1, 0), (3, 0), (13, 0), (4, 576), (4, 1200), (4, 68))
"""Codes of ICMP's "destination unreachable" and the next hop's MTU: network, host, port, prohibited, and fragmentation
needed."""
MULTICAST = 1


@dataclass
class Direction:
    """From one port to another."""

    up: bool = True
    loss: float = 0.0
    delay_s: float = 0.0005
    jitter_s: float = 0.0
    duplicates: float = 0.0
    damage: float = 0.0
    """Share of datagrams with a changed bit, or truncated; their checksum is right."""
    mtu: int = 1500
    """Larger IP packets vanish."""


@dataclass(order=True)
class _Due:
    at: float
    order: int
    port: str = field(compare=False)
    frame: bytes = field(compare=False)


class Ether(threading.Thread):
    """Runs until `close`. Attributes may be changed at any time."""

    def __init__(self, seed: int) -> None:
        super().__init__(name="ether", daemon=True)
        self.rng = random.Random(seed)
        self.paths: dict[tuple[str, str], Direction] = {}
        self.rate_bits_per_s = 50e6
        self.outside_ports: dict[str, int] = {}
        """By port: the UDP port that its datagrams leave with, as behind a NAT that lost its state."""
        self.datagrams: Counter[str] = Counter()
        """Sent by each port."""
        self.unsealed: set[str] = set()
        """Ports whose robots authenticate nothing: what goes to them or comes from them is neither damaged nor sent
        again."""
        self.too_long: set[tuple[str, str]] = set()
        """Directions in which a datagram exceeded the path's MTU."""
        self.failure: Exception | None = None
        self._recorded: deque[tuple[str, bytes]] = deque(maxlen=RECORDED)
        self._sent: dict[str, deque[bytes]] = {}
        """Recorded datagrams by their sender."""
        self._sockets: dict[str, socket.socket] = {}
        self._names: dict[int, str] = {}
        self._macs: dict[bytes, str] = {}
        self._due: list[_Due] = []
        self._order = 0
        self._busy_until = 0.0
        self._lock = threading.Lock()
        self._poll = select.poll()
        self._ended = threading.Event()

    def plug_in(self, name: str, interface: str) -> None:
        """Attach the near end of a veth pair."""
        own = socket.socket(socket.AF_PACKET, socket.SOCK_RAW | socket.SOCK_NONBLOCK, 0)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
        own.bind((interface, ETH_P_ALL))
        with self._lock:
            for other in self._sockets:
                self.paths[name, other], self.paths[other, name] = Direction(), Direction()
            self._sockets[name] = own
            self._names[own.fileno()] = name
            self._poll.register(own, select.POLLIN)

    def replay(self, count: int, *, source: tuple[str, int] | None = None) -> None:
        """Send recorded datagrams again; `source` (IPv4 address and port) replaces their sender's."""
        with self._lock:
            chosen = self.rng.choices(self._recorded, k=count) if self._recorded else []
            for port, frame in chosen:
                self._send_at(time.monotonic() + self.rng.uniform(0, 0.5), port, _from(frame, source))

    def send_icmp_errors(self, name: str, count: int) -> None:
        """Tell a robot that datagrams which it sent did not arrive: ports and hosts that are not reached, and paths
        that carry little. IPv4 only."""
        with self._lock:
            sent = [frame for frame in self._sent.get(name, ()) if frame[12:14] == IPV4]
            for frame in self.rng.choices(sent, k=count) if sent else []:
                code, mtu = self.rng.choice(ICMP_ERRORS)
                self._send_at(time.monotonic(), name, _icmp_error(frame, code, mtu))

    def close(self) -> None:
        self._ended.set()
        self.join()
        for own in self._sockets.values():
            own.close()

    def run(self) -> None:
        try:
            while not self._ended.is_set():
                self._turn()
        except Exception as error:  # noqa: BLE001
            self.failure = error

    def _turn(self) -> None:
        with self._lock:
            wait_s = self._due[0].at - time.monotonic() if self._due else 0.05
        for descriptor, _ in self._poll.poll(max(0.0, min(wait_s, 0.05)) * 1000):
            self._read(self._names[descriptor])
        now = time.monotonic()
        while True:
            with self._lock:
                if not self._due or self._due[0].at > now:
                    return
                due = heapq.heappop(self._due)
            # The interface is down.
            with contextlib.suppress(OSError):
                self._sockets[due.port].send(due.frame)

    def _read(self, name: str) -> None:
        for _ in range(64):
            try:
                frame, address = self._sockets[name].recvfrom(1 << 16)
            except BlockingIOError:
                return
            except OSError:
                return
            if address[2] == PACKET_OUTGOING:
                continue
            self._macs[frame[6:12]] = name
            to = self._macs.get(frame[:6])
            with self._lock:
                for other in list(self._sockets):
                    if other == name or (not frame[0] & MULTICAST and to is not None and to != other):
                        continue
                    if _udp_start(frame):
                        self._pass_on(name, other, frame)
                    elif _is_control(frame) and self.paths[name, other].up:
                        self._send_at(time.monotonic(), other, frame)

    def _pass_on(self, name: str, other: str, frame: bytes) -> None:
        path, rng, now = self.paths[name, other], self.rng, time.monotonic()
        self.datagrams[name] += 1
        if not path.up or rng.random() < path.loss:
            return
        if len(frame) - IP_START > path.mtu:
            self.too_long.add((name, other))
            return
        translated = self._translated(name, other, frame)
        if translated is None:
            return
        frame = _finished(translated)
        self._busy_until = max(self._busy_until, now) + len(frame) * 8 / self.rate_bits_per_s
        if self._busy_until - now > MAX_QUEUE_S:
            self._busy_until -= len(frame) * 8 / self.rate_bits_per_s
            return
        sealed = not {name, other} & self.unsealed
        if sealed:
            self._recorded.append((other, frame))
        self._sent.setdefault(name, deque(maxlen=RECORDED)).append(frame)
        for _ in range(2 if rng.random() < path.duplicates else 1):
            at = self._busy_until + path.delay_s + rng.random() * path.jitter_s
            self._send_at(at, other, self._damaged(frame) if sealed and rng.random() < path.damage else frame)

    def _translated(self, name: str, other: str, frame: bytes) -> bytes | None:
        """With the ports that a NAT gives; None if it does not know whom the datagram is for."""
        at = _udp_start(frame)
        source, target = struct.unpack_from(">HH", frame, at)
        if source == PORT:
            source = self.outside_ports.get(name, source)
        inside = self.outside_ports.get(other)
        if inside is not None and not frame[0] & MULTICAST:
            if target != inside:
                return None
            target = PORT
        return frame[:at] + struct.pack(">HH", source, target) + frame[at + 4 :]

    def _damaged(self, frame: bytes) -> bytes:
        payload = _udp_start(frame) + UDP_BYTES
        if len(frame) <= payload + 1:
            return frame
        at = self.rng.randrange(payload, len(frame))
        if self.rng.random() < 0.3:
            return _finished(frame[:at])
        return _finished(frame[:at] + bytes([frame[at] ^ 1 << self.rng.randrange(8)]) + frame[at + 1 :])

    def _send_at(self, at: float, port: str, frame: bytes) -> None:
        self._order += 1
        heapq.heappush(self._due, _Due(at, self._order, port, frame))


def _udp_start(frame: bytes) -> int:
    """The offset of the UDP header; 0 if there is none."""
    kind = frame[12:14]
    if kind == IPV4 and frame[IP_START] == 0x45 and frame[IP_START + 9] == socket.IPPROTO_UDP:
        return IP_START + IPV4_BYTES
    if kind == IPV6 and frame[IP_START + 6] == socket.IPPROTO_UDP:
        return IP_START + IPV6_BYTES
    return 0


def _is_control(frame: bytes) -> bool:
    """ARP, or ICMP: neighbor discovery, and what a kernel says of datagrams to a port that is closed."""
    kind = frame[12:14]
    return (
        kind == ARP
        or (kind == IPV4 and frame[IP_START + 9] == socket.IPPROTO_ICMP)
        or (kind == IPV6 and frame[IP_START + 6] == socket.IPPROTO_ICMPV6)
    )


def _from(frame: bytes, source: tuple[str, int] | None) -> bytes:
    if source is None:
        return frame
    host, port = source
    start, count = SOURCE[frame[12:14]]
    address = socket.inet_pton(socket.AF_INET if count == 4 else socket.AF_INET6, host)
    at = _udp_start(frame)
    return _finished(frame[:start] + address + frame[start + count : at] + struct.pack(">H", port) + frame[at + 2 :])


def _icmp_error(frame: bytes, code: int, mtu: int) -> bytes:
    """What the receiver of this datagram, or a router in its name, says to its sender (RFC 792, RFC 1191)."""
    packet = frame[IP_START:]
    message = bytearray(struct.pack(">BBHHH", 3, code, 0, 0, mtu) + packet[: IPV4_BYTES + 8])
    message[2:4] = struct.pack(">H", _checksum(message))
    header = bytearray(struct.pack(">BBHHHBBH", 0x45, 0, IPV4_BYTES + len(message), 0, 0, 64, socket.IPPROTO_ICMP, 0))
    header += packet[16:20] + packet[12:16]
    header[10:12] = struct.pack(">H", _checksum(header))
    return frame[6:12] + frame[:6] + IPV4 + header + message


def _finished(frame: bytes) -> bytes:
    """A datagram with the lengths and checksums that follow from its bytes; the kernel leaves its own to the
    hardware."""
    at = _udp_start(frame)
    ip, udp, payload = bytearray(frame[IP_START:at]), bytearray(frame[at : at + UDP_BYTES]), frame[at + UDP_BYTES :]
    udp[4:] = struct.pack(">HH", UDP_BYTES + len(payload), 0)
    if at == IP_START + IPV4_BYTES:
        ip[2:4] = struct.pack(">H", len(frame) - IP_START)
        ip[10:12] = bytes(2)
        ip[10:12] = struct.pack(">H", _checksum(ip))
    else:
        ip[4:6] = udp[4:6]
        udp[6:] = struct.pack(
            ">H", _checksum(ip[8:] + udp[4:6] + bytes([0, socket.IPPROTO_UDP]) + udp + payload) or 0xFFFF
        )
    return frame[:IP_START] + ip + udp + payload


def _checksum(data: bytearray) -> int:
    """RFC 1071."""
    total: int = sum(struct.unpack(f">{(len(data) + 1) // 2}H", data + bytes(len(data) % 2)))
    while total >> 16:
        total = (total & 0xFFFF) + (total >> 16)
    return total ^ 0xFFFF
