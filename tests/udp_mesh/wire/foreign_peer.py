"""A node written from docs/wire-format.md alone: nothing of udp_mesh is imported, only an AEAD cipher and zstd.

It does what that page requires of another implementation, in the simplest way: sends a hello, believes nodes that hear
it, fragments and reassembles messages, acknowledges each datagram individually, and retransmits what is missing twice a
second. A test connects it to a real daemon; if that fails, the page or the daemon is wrong.
"""

from __future__ import annotations

import os
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.udp_mesh.wire.foreign_format import (
    BROADCAST,
    COMPACT,
    CONFIRM,
    COVER,
    DATA,
    FIRST_UNREPAIRED_NUMBER,
    FLAG_TO_ALL,
    HELLO,
    INTRODUCTION,
    NUMBERED,
    RELIABLE,
    REPAIR,
    TIMED,
    TO_ALL,
    VERSION,
    Address,
    Channel,
    Fields,
    FleetKey,
    Parser,
    clock,
    compact_fragment,
    fragment,
    read_number,
    read_version,
    text,
    unpack,
)

HELLO_S, RESEND_S, HEARD_FOR_S = 0.2, 0.5, 0.7


@dataclass
class ReceivedMessage:
    source: str
    topic: str
    type_name: str
    payload: bytes
    flags: int
    body: bytes
    """As it was on the wire."""
    head: Fields


@dataclass
class Partial:
    head: Fields | None = None
    pieces: dict[int, bytes] = field(default_factory=dict)


class Peer:
    """One boot."""

    def __init__(self, keys: list[FleetKey], own: bytes, boot: bytes, address: Address) -> None:
        self.boot, self.address = boot, address
        self.out = Channel(keys[0], own, boot)
        self.own, self.into, self.broadcasts = own, list[Channel](), list[Channel]()
        self.set_keys(keys)
        self.largest, self.seen = -1, set[int]()
        """Packet numbers that arrived, whatever key they were sealed with."""
        self.name = ""
        self.heartbeat: Fields = {}
        self.heard_at = 0.0
        self.believed = self.answered = self.said_bye = False
        self.topics: dict[int, tuple[str, str]] = {}
        self.partials: dict[tuple[bool, int], Partial] = {}
        self.finished: set[tuple[bool, int]] = set()
        self.versions: dict[tuple[str, str], dict[bytes, bytes]] = {}
        """By topic and type."""
        self.next_id = 0
        self.in_flight: dict[int, list[tuple[bytes, set[int]]]] = {}
        """Message id -> per fragment its frames and the packets that carried it."""
        self.ends: dict[int, str] = {}

    def set_keys(self, keys: list[FleetKey]) -> None:
        """Seal with the first key and open with any; packet numbers go on."""
        number = self.out.next_number
        self.out = Channel(keys[0], self.own, self.boot)
        self.out.next_number = number
        for channels, receiver in ((self.into, self.own), (self.broadcasts, TO_ALL)):
            known = {channel.key.key_id: channel for channel in channels}
            channels[:] = [known.get(key.key_id) or Channel(key, self.boot, receiver) for key in keys]

    @property
    def features(self) -> int:
        return int(self.heartbeat.get("features", 0))


class ForeignNode:
    """`run` runs it on the socket until a condition holds."""

    def __init__(self, secret: bytes, name: str, own: socket.socket, neighbour: Address, features: int = 0) -> None:
        self.keys, self.name, self.socket, self.neighbour = [FleetKey(secret)], name, own, neighbour
        self.features = features
        self.confirms = True
        """Whether messages that ask for it are confirmed."""
        self.repairable: dict[int, bytes] = {}
        """By number, broadcasts as they are sent again."""
        self.requested: set[int] = set()
        """Broadcasts that were requested again."""
        self.new_fields = b""
        """Fields of a later version, at the end of the heartbeat's extension."""
        self.boot = os.urandom(16)
        self.to_all = Channel(self.keys[0], self.boot, TO_ALL)
        self.peers: dict[bytes, Peer] = {}
        self.arrived: list[ReceivedMessage] = []
        self.broadcasts = 0

    def set_keys(self, *secrets: bytes) -> None:
        """The first seals, all open."""
        self.keys = [FleetKey(secret) for secret in secrets]
        number = self.to_all.next_number
        self.to_all = Channel(self.keys[0], self.boot, TO_ALL)
        self.to_all.next_number = number
        for peer in self.peers.values():
            peer.set_keys(self.keys)

    def peer(self, name: str) -> Peer | None:
        return next((peer for peer in self.peers.values() if peer.name == name and peer.believed), None)

    def run(self, until: Callable[[], object], seconds: float) -> bool:
        """Run until `until` holds; False if that is not within `seconds`."""
        deadline, hello_at, resend_at = time.monotonic() + seconds, 0.0, 0.0
        self.socket.settimeout(0.02)
        while not until():
            now = time.monotonic()
            if now > deadline:
                return False
            if now >= hello_at:
                hello_at = now + HELLO_S
                self.socket.sendto(self.to_all.seal(HELLO, self.heartbeat()), self.neighbour)
            if now >= resend_at:
                resend_at = now + RESEND_S
                for peer in self.peers.values():
                    for pieces in list(peer.in_flight.values()):
                        self.leave(peer, pieces)
            try:
                datagram, address = self.socket.recvfrom(65_536)
            except TimeoutError:
                continue
            self.take(datagram, address)
        return True

    def heartbeat(self) -> bytes:
        now = time.monotonic()
        listed = [peer for peer in self.peers.values() if now - peer.heard_at < HEARD_FOR_S]
        heard = [peer.boot[:8] for peer in listed]
        numbers = (1, 1, self.features, 1000, len(heard), 0, self.to_all.next_number, self.broadcasts)
        head = b"\x01" + text(self.name) + struct.pack(">BBIHHIQI", *numbers)
        extension = b""
        if self.features & TIMED:
            echoes = [peer.heartbeat.get("clock", 0) // 256 for peer in listed]
            extension = clock().to_bytes(4, "big") + b"".join(echo.to_bytes(3, "big") for echo in echoes)
        elif self.new_fields:
            extension = bytes(4 + 3 * len(heard))
        extension += self.new_fields
        return head + bytes((len(heard),)) + b"".join(heard) + b"\x00" + bytes((len(extension),)) + extension

    def send(
        self,
        peer: Peer,
        topic: str,
        payload: bytes,
        *,
        priority: int = 5,
        size: int = 1000,
        flags: int = RELIABLE,
        life_ms: int = 0,
        leave_out: int | None = None,
    ) -> int:
        """Send a message to one peer in fragments of `size`; returns its number. The fragment `leave_out` is never
        sent."""
        number, peer.next_id = peer.next_id, peer.next_id + 1
        pieces = [payload[start : start + size] for start in range(0, len(payload), size)] or [b""]
        head = (len(payload), len(pieces), 0, 1000 + len(topic), priority, flags)
        announce = b"\x07" + struct.pack(">H", head[3]) + text(topic) + text("foreign/Type")
        peer.in_flight[number] = [
            (self._encoded(peer, announce, number, place, piece, head, life_ms), set())
            for place, piece in enumerate(pieces)
            if place != leave_out
        ]
        self.leave(peer, peer.in_flight[number])
        return number

    def _encoded(
        self, peer: Peer, announce: bytes, number: int, place: int, piece: bytes, head: tuple[int, ...], life_ms: int
    ) -> bytes:
        if place:
            return fragment(number, place, piece, None)
        if head[1] == 1 and peer.features & self.features & COMPACT:
            return announce + compact_fragment(number, piece, head, life_ms)
        return announce + fragment(number, 0, piece, head, life_ms=life_ms)

    def broadcast(self, topic: str, payload: bytes, *, repair: bool = False, lost: bool = False) -> None:
        """Broadcast a message in one datagram; with `repair` it is counted and sent again on request."""
        flags = FLAG_TO_ALL | REPAIR * repair
        head = (len(payload), 1, 0, 1000 + len(topic), 3, flags)
        announce = b"\x07" + struct.pack(">H", head[3]) + text(topic) + text("")
        number = FIRST_UNREPAIRED_NUMBER + self.to_all.next_number
        if repair:
            number, self.broadcasts = self.broadcasts, self.broadcasts + 1
            self.repairable[number] = announce + fragment(number, 0, payload, head, 16)
        sealed = self.to_all.seal(BROADCAST, announce + fragment(number, 0, payload, head))
        if not lost:
            self.socket.sendto(sealed, self.neighbour)

    def bye(self) -> None:
        self.socket.sendto(self.to_all.seal(HELLO, b"\x0a" + text("that is all")), self.neighbour)

    def leave(self, peer: Peer, pieces: list[tuple[bytes, set[int]]]) -> None:
        for frames, packets in pieces:
            packets.add(self.say(peer, frames))

    def say(self, peer: Peer, frames: bytes) -> int:
        """Send one datagram to one boot; returns its number."""
        kind = DATA if peer.answered else INTRODUCTION
        number = peer.out.next_number
        frames = frames if peer.answered else self.heartbeat() + frames
        if self.features & peer.features & TIMED:
            frames = b"\x0c" + clock().to_bytes(4, "big") + frames
        self.socket.sendto(peer.out.seal(kind, frames), peer.address)
        return number

    def take(self, datagram: bytes, address: Address) -> None:
        if datagram.startswith(COVER):
            datagram = datagram[13:-1]
        if len(datagram) < 23 or datagram[0] & 0xF0 != 0x90:
            return
        kind = datagram[0] & 15
        peer: Peer | None = None
        opened: tuple[int, bytes] | None = None
        if kind in (HELLO, INTRODUCTION):
            boot = datagram[5:21]
            place = next((at for at, key in enumerate(self.keys) if key.key_id == datagram[1:5]), None)
            if place is None or self.keys[place].check(datagram[:29]) != datagram[29:33] or boot == self.boot:
                return
            peer = self.peers.setdefault(boot, Peer(self.keys, self.boot, boot, address))
            opened = (peer.broadcasts if kind == HELLO else peer.into)[place].open(datagram)
        else:
            for peer in self.peers.values():
                channels = peer.broadcasts if kind == BROADCAST else peer.into
                opened = next(
                    (
                        found
                        for channel in channels
                        if channel.tag == datagram[1:3] and (found := channel.open(datagram)) is not None
                    ),
                    None,
                )
                if opened is not None:
                    break
        if peer is None or opened is None:
            return
        if kind in (INTRODUCTION, DATA):
            peer.seen.add(opened[0])
            peer.largest = max(peer.largest, opened[0])
        frames = Parser(opened[1]).frames()
        peer.believed |= kind in (INTRODUCTION, DATA)
        peer.believed |= any(self.boot[:8] in fields["heard"] for what, fields in frames if what == 1)
        peer.heard_at, peer.address = time.monotonic(), address
        self.take_frames(peer, kind, frames)

    def take_frames(self, peer: Peer, kind: int, frames: list[tuple[int, Fields]]) -> None:
        answer, expected = b"", kind == INTRODUCTION
        for what, fields in frames:
            match what:
                case 1:
                    peer.name, peer.heartbeat = fields["name"], fields
                case 2:
                    peer.answered = True
                    self.acknowledged(peer, fields["largest"], fields["missing"])
                case 3 if not fields["broadcast"]:
                    for number in fields["ids"]:
                        if peer.in_flight.pop(number, None):
                            peer.ends[number] = "delivered"
                case 4 if fields["reason"] != 2 and peer.in_flight.pop(fields["id"], None):
                    peer.ends[fields["id"]] = f"refused {fields['reason']}"
                case 5:
                    for number in fields["ids"]:
                        peer.partials.pop((bool(fields["broadcast"]), number), None)
                        peer.finished.add((bool(fields["broadcast"]), number))
                case 6:
                    self.requested.add(fields["id"])
                    if (broadcast := self.repairable.get(fields["id"])) is not None:
                        self.say(peer, broadcast)
                        continue
                    answer += b"\x05\x01\x00\x01" + fields["id"].to_bytes(4, "big")
                case 7:
                    peer.topics[fields["id"]] = (fields["name"], fields["type"])
                case 8:
                    answer += b"\x09" + fields["token"] + bytes(4)
                case 10:
                    peer.said_bye = True
                case 0x80 if peer.believed:
                    expected |= kind != BROADCAST
                    answer += self.piece(peer, fields, broadcast=fields["cast"] or kind == BROADCAST)
        if expected and kind != HELLO:
            answer = self.acknowledgment(peer) + answer
        if answer:
            self.say(peer, answer)

    def acknowledgment(self, peer: Peer) -> bytes:
        largest = peer.largest
        missing = sum(1 << i for i in range(min(256, largest)) if largest - 1 - i not in peer.seen)
        bitmap = missing.to_bytes((missing.bit_length() + 7) // 8, "little")
        head = b"\x02" + largest.to_bytes(6, "big") + bytes(3) + bytes(4)
        return head + bytes((len(bitmap),)) + bitmap + b"\x00"

    def acknowledged(self, peer: Peer, largest: int, missing: int) -> None:
        arrived = {largest - 1 - i for i in range(min(256, largest)) if not missing >> i & 1} | {largest}
        for number, pieces in list(peer.in_flight.items()):
            pieces[:] = [(frames, packets) for frames, packets in pieces if not packets & arrived]
            if not pieces:
                del peer.in_flight[number]
                peer.ends[number] = "delivered"

    def piece(self, peer: Peer, fields: Fields, *, broadcast: bool) -> bytes:
        """Keep a fragment; returns the confirmation of its message, if that is due."""
        key = (broadcast, fields["id"])
        asks = bool(fields["head"] and fields["head"]["flags"] & CONFIRM)
        confirmation = b"\x03\x00\x00\x01" + fields["id"].to_bytes(4, "big") if self.confirms else b""
        if key in peer.finished:
            return confirmation if asks else b""
        partial = peer.partials.setdefault(key, Partial())
        partial.head = fields["head"] or partial.head
        partial.pieces[fields["position"]] = fields["payload"]
        head = partial.head
        if head is None or len(partial.pieces) < head["fragments"]:
            return b""
        del peer.partials[key]
        peer.finished.add(key)
        body = b"".join(partial.pieces[place] for place in range(head["fragments"]))
        if len(body) != head["size"]:
            raise ValueError(f"{len(body)} bytes arrived of a message of {head['size']}")
        topic, type_name = peer.topics[head["topic"]]
        flags = head["flags"]
        if flags & NUMBERED:
            _, body = read_number(body)
        if flags & VERSION:
            payload = read_version(body, flags, peer.versions.setdefault((topic, type_name), {}))
        else:
            payload = unpack(body, flags)
        self.arrived.append(ReceivedMessage(peer.name, topic, type_name, payload, flags, body, head))
        return confirmation if flags & CONFIRM else b""
