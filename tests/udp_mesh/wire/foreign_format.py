"""The wire format as docs/wire-format.md states it: keys, channels, frames and versions, for `foreign_peer`."""

from __future__ import annotations

import hashlib
import hmac
import struct
import sys
import time
import zlib
from typing import Any

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

HELLO, BROADCAST, INTRODUCTION, DATA = range(4)
TO_ALL = bytes(16)
RELIABLE, COMPRESSED, FLAG_TO_ALL, REPAIR, CONFIRM, NUMBERED, FLAG_ZSTD, VERSION = 1, 2, 4, 8, 16, 32, 64, 128
ZLIB, TIMED, CONFIRMS, COMPACT, ZSTD, VERSIONS = 1, 4, 8, 16, 64, 128
FIRST_UNREPAIRED_NUMBER = 1 << 31
COVER = bytes.fromhex("02ffffffffffff00000000")

Address = tuple[str, int]
Fields = dict[str, Any]


def _hmac(key: bytes, text: bytes) -> bytes:
    return hmac.new(key, text, hashlib.sha256).digest()


def clock() -> int:
    """This node's clock in milliseconds, with an origin of its own, near to where it starts again at 0."""
    return (int(time.monotonic() * 1000) + (1 << 32) - 5000 - _STARTED_MS) & 0xFFFFFFFF


_STARTED_MS = int(time.monotonic() * 1000)


class FleetKey:
    def __init__(self, secret: bytes) -> None:
        self.prk = _hmac(b"udp_mesh wire 1 fleet key", secret)
        self.key_id = _hmac(self.prk, b"key id")[:4]
        self.check_key = _hmac(self.prk, b"header check")

    def check(self, header: bytes) -> bytes:
        return hashlib.blake2s(header, key=self.check_key, digest_size=4).digest()


class Channel:
    """All datagrams from one boot to one boot, or to all, under one key."""

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


def fragment(
    message_id: int, position: int, payload: bytes, head: tuple[int, ...] | None, flags: int = 0, life_ms: int = 0
) -> bytes:
    """A fragment that ends its datagram. `life_ms` is the remaining lifetime, 0: without a limit."""
    wide = position > 0xFFFF
    first = 0x80 | (head is not None) | 8 * wide | 32 * bool(life_ms) | flags
    return (
        struct.pack(">BI" + "HI"[wide], first, message_id, position)
        + (struct.pack(">IIIHBB", *head) if head is not None else b"")
        + (life_ms.to_bytes(4, "big") if life_ms else b"")
        + payload
    )


def compact_fragment(message_id: int, payload: bytes, head: tuple[int, ...], life_ms: int = 0) -> bytes:
    """A whole message that ends its datagram."""
    _, _, age, topic, priority, flags = head
    first = 0x80 | 1 | 64 | 32 * bool(life_ms)
    packed = struct.pack(">BIHBBH", first, message_id, topic, priority, flags, age)
    return packed + (life_ms.to_bytes(4, "big") if life_ms else b"") + payload


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
                (count,) = self.take("B")
                extension = bytes(self.take(f"{count}s")[0])
                if count >= 4:
                    values["clock"] = int.from_bytes(extension[:4], "big")
                echoes = [int.from_bytes(extension[at : at + 3], "big") for at in range(4, count - 2, 3)]
                return {"name": name, "heard": heard, "waiting": waiting, "echoes": echoes[: len(heard)], **values}
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
