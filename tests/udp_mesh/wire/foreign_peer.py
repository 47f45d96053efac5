"""A node written from docs/wire-format.md alone: nothing of udp_mesh is imported, only an AEAD cipher and zstd.

It does what that page requires of another implementation, in the simplest way: sends a hello, believes nodes that hear
it, fragments and reassembles messages, acknowledges each datagram individually, and retransmits what is missing twice a
second. A test connects it to a real daemon; if that fails, the page or the daemon is wrong.
"""

from __future__ import annotations

import hashlib
import hmac
import os
import socket
import struct
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from backports import zstd
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

HELLO, BROADCAST, INTRODUCTION, DATA = range(4)
TO_ALL = bytes(16)
RELIABLE, COMPRESSED, FLAG_TO_ALL, REPAIR, NUMBERED, FLAG_ZSTD, VERSION = 1, 2, 4, 8, 32, 64, 128
ZLIB, REPAIRS, ZSTD, VERSIONS = 1, 2, 64, 128
FIRST_UNREPAIRED_NUMBER = 1 << 31
COVER = bytes.fromhex("02ffffffffffff00000000")
HELLO_S, RESEND_S, HEARD_FOR_S = 0.2, 0.5, 0.7

Address = tuple[str, int]
Fields = dict[str, Any]


def _hmac(key: bytes, text: bytes) -> bytes:
    return hmac.new(key, text, hashlib.sha256).digest()


class FleetKey:
    def __init__(self, secret: bytes) -> None:
        self.prk = _hmac(b"udp_mesh wire 1 fleet key", secret)
        self.key_id = _hmac(self.prk, b"key id")[:4]
        self.check_key = _hmac(self.prk, b"header check")

    def check(self, header: bytes) -> bytes:
        return hashlib.blake2s(header, key=self.check_key, digest_size=4).digest()


class Channel:
    """All datagrams from one boot to one boot, or to all."""

    def __init__(self, key: FleetKey, sender: bytes, receiver: bytes) -> None:
        # one block of HKDF-Expand is just 32 bytes
        okm = _hmac(key.prk, b"channel" + sender + receiver + b"\x01")
        self.cipher, self.salt, self.tag = AESGCM(okm[:16]), okm[16:20], okm[20:22]
        self.key, self.sender = key, sender
        self.next_number, self.largest = 0, -1
        self.seen: set[int] = set()

    def seal(self, kind: int, frames: bytes, number: int | None = None) -> bytes:
        if number is None:
            number, self.next_number = self.next_number, self.next_number + 1
        header = bytes((0x90 | kind,))
        if kind in (HELLO, INTRODUCTION):
            header += self.key.key_id + self.sender + number.to_bytes(8, "big")
            header += self.key.check(header)
        else:
            header += self.tag + (number & 0xFFFFFFFF).to_bytes(4, "big")
        return header + self.cipher.encrypt(self.salt + number.to_bytes(8, "big"), frames, header)

    def open(self, datagram: bytes) -> tuple[int, bytes] | None:
        size = 33 if datagram[0] & 15 in (HELLO, INTRODUCTION) else 7
        if size == 33:
            number = int.from_bytes(datagram[21:29], "big")
        else:
            low, expected = int.from_bytes(datagram[3:7], "big"), self.largest + 1
            near = (expected & ~0xFFFFFFFF) | low
            number = min((near, near + (1 << 32), abs(near - (1 << 32))), key=lambda one: abs(one - expected))
        if number in self.seen:
            return None
        try:
            frames = self.cipher.decrypt(self.salt + number.to_bytes(8, "big"), datagram[size:], datagram[:size])
        except InvalidTag:
            return None
        self.seen.add(number)
        self.largest = max(self.largest, number)
        return number, frames


# Frames


def text(value: str) -> bytes:
    raw = value.encode()
    return bytes((len(raw),)) + raw


def fragment(message_id: int, position: int, payload: bytes, head: tuple[int, ...] | None, flags: int = 0) -> bytes:
    """A fragment that ends its datagram."""
    wide = position > 0xFFFF
    first = 0x80 | (head is not None) | 8 * wide | flags
    return (
        struct.pack(">BI" + "HI"[wide], first, message_id, position)
        + (struct.pack(">IIIHBB", *head) if head is not None else b"")
        + payload
    )


class Parser:
    """Reads the frames of one datagram."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from(">" + form, self.data, self.at)
        self.at += struct.calcsize(">" + form)
        return values

    def text(self) -> str:
        (count,) = self.take("B")
        return bytes(self.take(f"{count}s")[0]).decode()

    def waiting(self) -> list[tuple[int, int]]:
        return [self.take("BH") for _ in range(self.take("B")[0])]

    def frames(self) -> list[tuple[int, Fields]]:
        found = []
        while self.at < len(self.data):
            (kind,) = self.take("B")
            found.append((kind & 0x80 or kind, self.fragment(kind) if kind & 0x80 else self.fields(kind)))
        return found

    def fields(self, kind: int) -> Fields:
        match kind:
            case 1:
                name = self.text()
                names = ("lowest", "highest", "features", "interval", "online", "rate", "number", "messages")
                values = dict(zip(names, self.take("BBIHHIQI"), strict=True))
                heard = [self.take("8s")[0] for _ in range(self.take("B")[0])]
                waiting = self.waiting()
                (extension,) = self.take("B")
                self.at += extension
                return {"name": name, "heard": heard, "waiting": waiting, **values}
            case 2:
                largest, delay = (int.from_bytes(raw, "big") for raw in self.take("6s3s"))
                width = self.take("IB")[1]
                missing = int.from_bytes(self.take(f"{width}s")[0], "little")
                return {"largest": largest, "delay": delay, "missing": missing, "waiting": self.waiting()}
            case 3 | 5:
                broadcast, count = self.take("BH")
                return {"broadcast": broadcast, "ids": self.take(f"{count}I")}
            case 4:
                return dict(zip(("broadcast", "id", "reason"), self.take("BIB"), strict=True))
            case 6:
                message_id, count = self.take("IB")
                return {"id": message_id, "ranges": [self.take("II") for _ in range(count)]}
            case 7:
                return {"id": self.take("H")[0], "name": self.text(), "type": self.text()}
            case 8:
                return {"token": self.take("8s")[0]}
            case 9:
                return dict(zip(("token", "held"), self.take("8sI"), strict=True))
            case 10:
                return {"reason": self.text()}
            case 12:
                return {"clock": self.take("I")[0]}
        raise ValueError(f"no frame of type {kind}")

    def fragment(self, kind: int) -> Fields:
        if kind & 64:
            return self.compact(kind)
        message_id, position = self.take("II" if kind & 8 else "IH")
        names = ("size", "fragments", "age", "topic", "priority", "flags")
        head = dict(zip(names, self.take("IIIHBB"), strict=True)) if kind & 1 else None
        if kind & 32 and head is not None:
            head["life"] = self.take("I")[0]
        count = self.take("H")[0] if kind & 2 else len(self.data) - self.at
        (payload,) = self.take(f"{count}s")
        return {"id": message_id, "position": position, "head": head, "payload": payload, "cast": bool(kind & 16)}

    def compact(self, kind: int) -> Fields:
        message_id, *fields = self.take("IHBBH")
        head = dict(zip(("topic", "priority", "flags", "age"), fields, strict=True))
        if kind & 32:
            head["life"] = self.take("I")[0]
        count = self.take("H")[0] if kind & 2 else len(self.data) - self.at
        (payload,) = self.take(f"{count}s")
        head |= {"size": count, "fragments": 1}
        return {"id": message_id, "position": 0, "head": head, "payload": payload, "cast": bool(kind & 16)}


# Versions


def version_hash(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=8).digest()


def unpack(body: bytes, flags: int, prefix: bytes = b"") -> bytes:
    """The content of a message's body, or of a version's after its header."""
    if not flags & COMPRESSED:
        return body
    if not flags & FLAG_ZSTD:
        return zlib.decompress(body)
    return zstd.decompress(body, zstd_dict=zstd.ZstdDict(prefix, is_raw=True).as_prefix if prefix else None)


def read_version(body: bytes, flags: int, held: dict[bytes, bytes]) -> bytes:
    """A version, decoded with those held by the first 4 bytes of their hashes; it is added to them."""
    base, digest, content = body[:4], body[4:12], body[12:]
    version = unpack(content, flags, held[base] if base != bytes(4) else b"")
    if version_hash(version) != digest:
        raise ValueError("a version has another hash")
    held[digest[:4]] = version
    return version


def difference(version: bytes, base: bytes) -> bytes:
    """The body of a version as the difference to another one."""
    compressor = zstd.ZstdCompressor(zstd_dict=zstd.ZstdDict(base, is_raw=True).as_prefix)
    compressor.set_pledged_input_size(len(version))
    packed = compressor.compress(version, zstd.ZstdCompressor.FLUSH_FRAME)
    return version_hash(base)[:4] + version_hash(version) + packed


def read_number(body: bytes) -> tuple[int, bytes]:
    """The number of a message's copies on thin links, and the rest of its body."""
    return int.from_bytes(body[:2], "big"), body[2:]


# The node


@dataclass
class ReceivedMessage:
    source: str
    topic: str
    type_name: str
    payload: bytes
    flags: int
    body: bytes
    """As it was on the wire."""


@dataclass
class Partial:
    head: Fields | None = None
    pieces: dict[int, bytes] = field(default_factory=dict)


class Peer:
    """One boot."""

    def __init__(self, key: FleetKey, own: bytes, boot: bytes, address: Address) -> None:
        self.boot, self.address = boot, address
        self.out, self.into = Channel(key, own, boot), Channel(key, boot, own)
        self.broadcasts = Channel(key, boot, TO_ALL)
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


class ForeignNode:
    """`run` runs it on the socket until a condition holds."""

    def __init__(self, secret: bytes, name: str, own: socket.socket, neighbour: Address, features: int = 0) -> None:
        self.key, self.name, self.socket, self.neighbour = FleetKey(secret), name, own, neighbour
        self.features = features
        self.new_fields = b""
        """Fields of a later version, at the end of the heartbeat's extension."""
        self.boot = os.urandom(16)
        self.to_all = Channel(self.key, self.boot, TO_ALL)
        self.peers: dict[bytes, Peer] = {}
        self.arrived: list[ReceivedMessage] = []
        self.broadcasts = 0

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
        heard = [peer.boot[:8] for peer in self.peers.values() if now - peer.heard_at < HEARD_FOR_S]
        numbers = (1, 1, self.features, 1000, len(heard), 0, self.to_all.next_number, self.broadcasts)
        head = b"\x01" + text(self.name) + struct.pack(">BBIHHIQI", *numbers)
        extension = bytes(4 + 3 * len(heard)) + self.new_fields if self.new_fields else b""
        return head + bytes((len(heard),)) + b"".join(heard) + b"\x00" + bytes((len(extension),)) + extension

    def send(
        self, peer: Peer, topic: str, payload: bytes, *, priority: int = 5, size: int = 1000, flags: int = RELIABLE
    ) -> int:
        """Send a message to one peer in fragments of `size`; returns its number."""
        number, peer.next_id = peer.next_id, peer.next_id + 1
        pieces = [payload[start : start + size] for start in range(0, len(payload), size)] or [b""]
        head = (len(payload), len(pieces), 0, 1000 + len(topic), priority, flags)
        announce = b"\x07" + struct.pack(">H", head[3]) + text(topic) + text("foreign/Type")
        peer.in_flight[number] = [
            ((b"" if place else announce) + fragment(number, place, piece, None if place else head), set())
            for place, piece in enumerate(pieces)
        ]
        self.leave(peer, peer.in_flight[number])
        return number

    def broadcast(self, topic: str, payload: bytes) -> None:
        """Broadcast a message in one datagram, without repair."""
        head = (len(payload), 1, 0, 1000 + len(topic), 3, FLAG_TO_ALL)
        announce = b"\x07" + struct.pack(">H", head[3]) + text(topic) + text("")
        frames = announce + fragment(FIRST_UNREPAIRED_NUMBER + self.to_all.next_number, 0, payload, head)
        self.socket.sendto(self.to_all.seal(BROADCAST, frames), self.neighbour)

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
            if (
                datagram[1:5] != self.key.key_id
                or self.key.check(datagram[:29]) != datagram[29:33]
                or boot == self.boot
            ):
                return
            peer = self.peers.setdefault(boot, Peer(self.key, self.boot, boot, address))
            opened = (peer.broadcasts if kind == HELLO else peer.into).open(datagram)
        else:
            for peer in self.peers.values():
                channel = peer.broadcasts if kind == BROADCAST else peer.into
                opened = channel.open(datagram) if channel.tag == datagram[1:3] else None
                if opened is not None:
                    break
        if peer is None or opened is None:
            return
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
                case 7:
                    peer.topics[fields["id"]] = (fields["name"], fields["type"])
                case 8:
                    answer += b"\x09" + fields["token"] + bytes(4)
                case 10:
                    peer.said_bye = True
                case 0x80 if peer.believed:
                    expected |= kind != BROADCAST
                    self.piece(peer, fields, broadcast=fields["cast"] or kind == BROADCAST)
        if expected and kind != HELLO:
            answer = self.acknowledgement(peer) + answer
        if answer:
            self.say(peer, answer)

    def acknowledgement(self, peer: Peer) -> bytes:
        largest = peer.into.largest
        missing = sum(1 << i for i in range(min(256, largest)) if largest - 1 - i not in peer.into.seen)
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

    def piece(self, peer: Peer, fields: Fields, *, broadcast: bool) -> None:
        key = (broadcast, fields["id"])
        if key in peer.finished:
            return
        partial = peer.partials.setdefault(key, Partial())
        partial.head = fields["head"] or partial.head
        partial.pieces[fields["position"]] = fields["payload"]
        head = partial.head
        if head is None or len(partial.pieces) < head["fragments"]:
            return
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
        self.arrived.append(ReceivedMessage(peer.name, topic, type_name, payload, flags, body))
