"""A channel: all datagrams from one boot of a node to one boot of another, or to all.

1. Both ends derive the channel's key from the fleet key and the two boot ids (HKDF-Expand, RFC 5869). Boot ids are
   random per process, so a restarted sender or receiver has new keys: packet numbers may restart at 0 without ever
   reusing a nonce, and packets recorded for an earlier boot cannot be opened.
2. The sender seals: header | AES-128-GCM(key, nonce = salt ‖ packet number, frames, associated data = header).
3. The receiver checks the header's hash (long header), the replay window, and only then the cipher.

A channel to all is keyed by the sender's boot alone, so its packets can be replayed to a node that has just started and
has no window yet. Accept them only from a boot that was verified in a channel of its own (an INTRODUCTION or DATA
datagram bound to our boot), and raise the window's floor to that heartbeat's `broadcast_number`.
"""

from __future__ import annotations

import hmac
import struct
from collections.abc import Sequence

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from udp_mesh.crypto.keys import Key
from udp_mesh.crypto.replay import ReplayWindow
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.header import (
    BROADCAST_BYTE,
    CHECK_BYTES,
    DATA_BYTE,
    LONG_HEADER_BYTES,
    NUMBER_LOW_MASK,
    SEAL_TAG_BYTES,
    SHORT_HEADER,
    SHORT_HEADER_BYTES,
    Kind,
    LongHeader,
    encode_long,
    parse_header,
)
from udp_mesh.wire.limits import BOOT_ID_BYTES

MAX_PACKET_NUMBER = (1 << 48) - 1
"""An acknowledgment carries a packet number in 48 bits: 89 years at 100,000 packets a second."""

SHORT_OVERHEAD_BYTES = SHORT_HEADER_BYTES + SEAL_TAG_BYTES
"""23 B: what a BROADCAST or DATA datagram adds to its frames."""
LONG_OVERHEAD_BYTES = LONG_HEADER_BYTES + SEAL_TAG_BYTES
"""49 B: what a HELLO or INTRODUCTION datagram adds to its frames."""

TO_ALL = bytes(BOOT_ID_BYTES)
"""Used as the receiver's boot in a channel to all."""

_NONCE = struct.Struct(">4sQ")


class OpenError(DecodeError):
    """The datagram cannot be opened: forged, damaged, or for another boot."""


class ReplayError(OpenError):
    """The datagram's packet number was already seen, or is too old to know."""


class _Channel:
    """The values that both ends derive: cipher, nonce salt and the public tag.

    The cipher is created on first use: in a large team most nodes never send each other anything.
    """

    __slots__ = ("_cipher", "_salt", "_secret", "key", "tag")

    _cipher: AESGCM

    def __init__(self, key: Key, sender_boot: bytes, receiver_boot: bytes) -> None:
        if len(sender_boot) != BOOT_ID_BYTES or len(receiver_boot) != BOOT_ID_BYTES:
            raise ValueError(f"boot id: expected {BOOT_ID_BYTES} bytes")
        material = hmac.digest(key.prk, b"channel" + sender_boot + receiver_boot + b"\x01", "sha256")
        self.key = key
        self._secret = material[:16]
        self._salt = material[16:20]
        self.tag = int.from_bytes(material[20:22], "big")
        """Two derived bytes carried by short headers. Several channels may share a tag; try each."""

    def __getattr__(self, name: str) -> AESGCM:
        # Only called for a slot not yet set.
        if name != "_cipher":
            raise AttributeError(name)
        self._cipher = AESGCM(self._secret)
        return self._cipher


class SendChannel(_Channel):
    """Seals datagrams and assigns the packet numbers. `receiver_boot=TO_ALL` for the channel to all."""

    __slots__ = ("_first_byte", "_long", "boot_id", "next_number")

    def __init__(self, key: Key, sender_boot: bytes, receiver_boot: bytes = TO_ALL) -> None:
        super().__init__(key, sender_boot, receiver_boot)
        self.boot_id = sender_boot
        self.next_number = 0
        """The packet number of the next datagram sealed."""
        to_all = receiver_boot == TO_ALL
        self._first_byte = BROADCAST_BYTE if to_all else DATA_BYTE
        self._long = Kind.HELLO if to_all else Kind.INTRODUCTION

    def seal(self, frames: bytes | bytearray | memoryview) -> tuple[int, bytes]:
        """Packet number and datagram with the short header (23 B more than the frames)."""
        number = self.next_number
        return number, self.seal_run((frames,))[0]

    def seal_run(self, run: Sequence[bytes | bytearray | memoryview]) -> list[bytes]:
        """Seal datagrams under consecutive numbers. On a fast link most of the processor time is the cost of calls."""
        first = self._take_numbers(len(run))
        first_byte, tag, salt = self._first_byte, self.tag, self._salt
        pack_header, pack_nonce, encrypt = SHORT_HEADER.pack, _NONCE.pack, self._cipher.encrypt
        sealed = []
        for number, frames in enumerate(run, first):
            header = pack_header(first_byte, tag, number & NUMBER_LOW_MASK)
            sealed.append(header + encrypt(pack_nonce(salt, number), frames, header))
        return sealed

    def seal_long(self, frames: bytes | bytearray | memoryview) -> tuple[int, bytes]:
        """Packet number and datagram with the long header (49 B more), for peers that may not know this boot yet."""
        number = self._take_numbers(1)
        clear = encode_long(self._long, self.key.key_id, self.boot_id, number)
        header = clear + self.key.check(clear)
        return number, header + self._cipher.encrypt(_NONCE.pack(self._salt, number), frames, header)

    def _take_numbers(self, count: int) -> int:
        """The first of `count` consecutive numbers."""
        number = self.next_number
        if number + count - 1 > MAX_PACKET_NUMBER:
            raise OverflowError("packet numbers of this channel are exhausted; restart the node for a new boot id")
        self.next_number = number + count
        return number


class ReceiveChannel(_Channel):
    """Opens the datagrams of one sender boot to us (or to all), each packet number once."""

    __slots__ = ("receiver_boot", "window")

    def __init__(self, key: Key, sender_boot: bytes, receiver_boot: bytes = TO_ALL) -> None:
        super().__init__(key, sender_boot, receiver_boot)
        self.receiver_boot = receiver_boot
        self.window = ReplayWindow()

    def open(self, data: bytes | bytearray | memoryview, number_low: int) -> tuple[int, bytes]:
        """Packet number and encoded frames (for `codec.decode`) of a datagram with a short header; `number_low` is that
        header's. Raises `ReplayError` or `OpenError`."""
        number = expand_number(number_low, self.window.largest)
        return self._open(memoryview(data), number, SHORT_HEADER_BYTES)

    def open_long(self, data: bytes | bytearray | memoryview, header: LongHeader) -> tuple[int, bytes]:
        """The same for a datagram with a long header whose check has passed (`check_long`)."""
        if header.number > MAX_PACKET_NUMBER:
            raise OpenError(f"packet number: expected at most 48 bits, found {header.number}")
        return self._open(memoryview(data), header.number, LONG_HEADER_BYTES)

    def open_copy(self, data: bytes | bytearray | memoryview) -> bytes:
        """The encoded frames of a datagram that may have been opened before. Raises `OpenError` or `DecodeError`."""
        header = parse_header(data)
        if isinstance(header, LongHeader):
            number, header_bytes = header.number, LONG_HEADER_BYTES
        else:
            number, header_bytes = expand_number(header.number_low, self.window.largest), SHORT_HEADER_BYTES
        return self._decrypt(memoryview(data), number, header_bytes)

    def _open(self, view: memoryview, number: int, header_bytes: int) -> tuple[int, bytes]:
        window = self.window
        if not window.would_accept(number):
            raise ReplayError(f"packet {number} was already seen or is too old")
        frames = self._decrypt(view, number, header_bytes)
        window.accept(number)
        return number, frames

    def _decrypt(self, view: memoryview, number: int, header_bytes: int) -> bytes:
        try:
            return self._cipher.decrypt(_NONCE.pack(self._salt, number), view[header_bytes:], view[:header_bytes])
        except InvalidTag as error:
            raise OpenError(f"packet {number} cannot be decrypted") from error


def age_together(channels: Sequence[ReceiveChannel], now: float) -> None:
    """Age the replay windows of channels that differ in their key alone. Numbers continue from key to key, so what a
    node could not open for want of a key is as old as what it opened with another one."""
    largest = max((channel.window.largest for channel in channels), default=-1)
    for channel in channels:
        channel.window.age(now, largest)


def check_long(key: Key, data: bytes | bytearray | memoryview, header: LongHeader) -> None:
    """Raises `OpenError` unless the long header was written by a holder of `key` (one short hash, no key derived)."""
    clear = memoryview(data)[: LONG_HEADER_BYTES - CHECK_BYTES]
    if not hmac.compare_digest(key.check(clear), header.check):
        raise OpenError("long header: its check does not match")


def expand_number(low: int, largest: int) -> int:
    """The full packet number with these low 32 bits that is nearest to the next expected number (as RFC 9000, A.3)."""
    expected = largest + 1
    candidate = (expected & ~0xFFFFFFFF) | low
    if candidate <= expected - 0x80000000:
        return candidate + 0x100000000
    if candidate > expected + 0x80000000 and candidate >= 0x100000000:
        return candidate - 0x100000000
    return candidate
