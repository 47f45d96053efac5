"""The loop of the legacy program, as its published source has it (docs/facts/legacy-wire.md): bytes and time in, bytes
out. `SocketLegacyNode` adds its socket.

Each turn of the loop takes one message of the programs, waits up to 10 ms for one datagram, and sends at most five
fragments of broadcasts. A message to an offline peer is dropped.
"""

from __future__ import annotations

import queue
import select
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field

from tests.udp_mesh.core.legacy_program import OFFLINE_TIMEOUT_S, LegacyProgram
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.legacy import (
    Host,
    LegacyAck,
    LegacyDatagram,
    LegacyPayload,
    PriorityMeshData,
    decode_legacy,
    encode_legacy,
    encode_mesh_data,
    fragment_legacy,
)

PORT = 8700
HEARTBEAT_S = 1.0
SELECT_S = 0.01
BROADCAST_FRAGMENTS = 5
"""A longer message to all is sent to each peer; and so many leave in one turn of the loop."""
FRAGMENT_BYTES = 1300
FIRST_BROADCAST = 0x8000
TO_ALL = "all"
TYPE = "std_msgs/String"


@dataclass
class Peer:
    name: str
    address: str
    heard_at: float
    is_offline: bool = False
    program: LegacyProgram = field(default_factory=LegacyProgram)


class LegacyNode:
    """The transport of one robot. `transmit` sends bytes to an address; `on_message` gets a source's name and what came
    from it."""

    def __init__(
        self,
        name: str,
        address: str,
        broadcast: str,
        transmit: Callable[[bytes, str], object],
        on_message: Callable[[str, PriorityMeshData], None],
    ) -> None:
        self.name, self.address, self.broadcast = name, address, broadcast
        self.transmit = transmit
        self.on_message = on_message
        self.peers: dict[str, Peer] = {}
        """By address, once heard."""
        self.broadcasts: list[LegacyPayload] = []
        self.broadcast_sequence = FIRST_BROADCAST
        self._heartbeat_at = float("-inf")

    def begin_turn(self, message: PriorityMeshData | None, now: float) -> None:
        """What a turn does before it waits for a datagram."""
        if now >= self._heartbeat_at:
            self._heartbeat_at = now + HEARTBEAT_S
            self.send(Host(self.name, self.address), self.broadcast)
        if message is not None:
            self.send_message(message, now)

    def end_turn(self, received: tuple[bytes, str] | None, now: float) -> None:
        """What it does then, with the datagram that came from this address."""
        if received is not None and received[1] != self.address:
            self.receive(*received, now)
        self.check_peers(now)
        for fragment in self.broadcasts[:BROADCAST_FRAGMENTS]:
            self.send(fragment, self.broadcast)
        del self.broadcasts[:BROADCAST_FRAGMENTS]

    def send(self, datagram: LegacyDatagram, address: str) -> None:
        self.transmit(encode_legacy(datagram), address)

    def send_message(self, message: PriorityMeshData, now: float) -> None:
        data = encode_mesh_data(message)
        if message.host == TO_ALL and len(data) < FRAGMENT_BYTES * BROADCAST_FRAGMENTS:
            self.broadcast_sequence = (self.broadcast_sequence + 1) & 0xFFFF | FIRST_BROADCAST
            chunks = fragment_legacy(data)
            self.broadcasts += [
                LegacyPayload(self.broadcast_sequence, place, len(chunks), chunk, wants_ack=False)
                for place, chunk in enumerate(chunks)
            ]
            return
        for peer in self.peers.values():
            if not peer.is_offline and message.host in (TO_ALL, peer.name):
                peer.program.push_message(message)
                self.fill(peer, now)

    def fill(self, peer: Peer, now: float) -> None:
        for fragment in peer.program.fill_in_flight(now):
            self.send(fragment, peer.address)

    def receive(self, raw: bytes, address: str, now: float) -> None:
        try:
            datagram = decode_legacy(raw)
        except DecodeError:
            return
        if isinstance(datagram, Host):
            peer = self.peers.setdefault(address, Peer(datagram.name, address, now))
            peer.heard_at, peer.is_offline = now, False
            return
        known = self.peers.get(address)
        if known is None:
            return
        known.is_offline = False
        if isinstance(datagram, LegacyAck):
            known.program.on_ack(datagram)
            self.fill(known, now)
            return
        ack, message = known.program.on_fragment(datagram, now)
        if datagram.wants_ack:
            self.send(ack, address)
        if message is not None:
            self.on_message(known.name, message)

    def check_peers(self, now: float) -> None:
        for peer in self.peers.values():
            if peer.is_offline:
                continue
            if now - peer.heard_at > OFFLINE_TIMEOUT_S or peer.program.is_stalled(now):
                peer.is_offline = True
                peer.program.flush()
            peer.program.prune(now)


class SocketLegacyNode(LegacyNode):
    """With a socket of its own. `outgoing` takes messages from any thread, their `host` being the receiver."""

    def __init__(
        self, name: str, address: str, broadcast: str, on_message: Callable[[str, PriorityMeshData], None]
    ) -> None:
        self.socket = socket.socket(type=socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self.socket.bind(("", PORT))
        self.outgoing: queue.Queue[PriorityMeshData] = queue.Queue()
        super().__init__(
            name, address, broadcast, lambda data, host: self.socket.sendto(data, (host, PORT)), on_message
        )

    def turn(self) -> None:
        """One turn of the loop."""
        message = None
        with suppress(queue.Empty):
            message = self.outgoing.get_nowait()
        self.begin_turn(message, time.monotonic())
        received = None
        if select.select([self.socket], [], [], SELECT_S)[0]:
            raw, (address, _) = self.socket.recvfrom(65536)
            received = raw, address
        self.end_turn(received, time.monotonic())
