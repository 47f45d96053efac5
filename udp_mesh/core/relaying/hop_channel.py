"""Seals relay datagrams: keys derived for hops, one channel to all and one to each neighbor's boot.

A hop key is derived from the fleet key, or from a relay key that relays outside the fleet may hold too; it never seals
what the ends of a path seal. A proof of membership shows the holders of a fleet key that another node holds it, so that
a relay that could read what it passes on is distinguished from one that cannot.
"""

from __future__ import annotations

import hmac
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from udp_mesh.crypto import TO_ALL, Key, OpenError, ReceiveChannel, ReplayError, SendChannel, age_together, check_long
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.header import Kind, LongHeader, parse_header
from udp_mesh.wire.relay import PROOF_BYTES, RELAY_BYTE

MAX_REMEMBERED_BOOTS = 1024
"""Boots whose packet numbers are remembered, so that none is used or accepted twice."""

_MARK = bytes((RELAY_BYTE,))


def hop_key(key: Key) -> Key:
    """The key of hops that is derived from a fleet's or a relay key."""
    return Key(hmac.digest(key.prk, b"relay hop", "sha256"))


def membership_proof(key: Key, boot_id: bytes) -> bytes:
    """Shows holders of this fleet key that the boot holds it, too."""
    return hmac.digest(key.prk, b"relay member" + boot_id, "sha256")[:PROOF_BYTES]


def is_member(keys: Iterable[Key], boot_id: bytes, proofs: Sequence[bytes]) -> bool:
    """Whether a boot that showed these proofs holds one of the fleet keys."""
    return any(membership_proof(key, boot_id) in proofs for key in keys)


class _Numbers(NamedTuple):
    next_number: int
    data: int
    hello: int
    """The next numbers accepted from it, to us and to all."""


class Hop:
    """The channels between us and one boot of a neighbor."""

    __slots__ = ("boot_id", "data", "hello", "send")

    def __init__(self, keys: tuple[Key, ...], own: bytes, boot_id: bytes) -> None:
        self.boot_id = boot_id
        self.send = SendChannel(keys[0], own, boot_id)
        self.data = [ReceiveChannel(key, boot_id, own) for key in keys]
        self.hello = [ReceiveChannel(key, boot_id, TO_ALL) for key in keys]

    def numbers(self) -> _Numbers:
        return _Numbers(self.send.next_number, _next_new(self.data), _next_new(self.hello))

    def restore(self, numbers: _Numbers) -> None:
        self.send.next_number = max(self.send.next_number, numbers.next_number)
        for channels, floor in ((self.data, numbers.data), (self.hello, numbers.hello)):
            for channel in channels:
                channel.window.raise_floor(floor)


def _next_new(channels: Sequence[ReceiveChannel]) -> int:
    return max(channel.window.next_new for channel in channels)


class HopChannels:
    """All channels of this node's hops. `hops` maps boot ids to those of neighbors."""

    def __init__(self, keys: tuple[Key, ...], own: bytes) -> None:
        self._own = own
        self._keys = tuple(map(hop_key, keys))
        self.hops: dict[bytes, Hop] = {}
        self._tags: dict[int, list[tuple[ReceiveChannel, Hop]]] = {}
        self._to_all = SendChannel(self._keys[0], own)
        self._remembered: dict[bytes, _Numbers] = {}
        self._send_floor = 0

    def set_keys(self, keys: tuple[Key, ...]) -> None:
        """Use these keys; packet numbers continue."""
        fresh = tuple(map(hop_key, keys))
        if fresh == self._keys:
            return
        self._keys = fresh
        number = self._to_all.next_number
        self._to_all = SendChannel(fresh[0], self._own)
        self._to_all.next_number = number
        for boot_id in list(self.hops):
            self.forget(boot_id)
            self.add(boot_id)

    def add(self, boot_id: bytes) -> Hop:
        """The channels to and from this boot, continued if they were used before."""
        hop = self.hops.get(boot_id)
        if hop is None:
            hop = self.hops[boot_id] = Hop(self._keys, self._own, boot_id)
            hop.send.next_number = self._send_floor
            numbers = self._remembered.pop(boot_id, None)
            if numbers is not None:
                hop.restore(numbers)
            for channel in hop.data:
                self._tags.setdefault(channel.tag, []).append((channel, hop))
        return hop

    def forget(self, boot_id: bytes) -> None:
        """Drop the channels; their numbers are remembered."""
        hop = self.hops.pop(boot_id)
        self._remembered[boot_id] = hop.numbers()
        if len(self._remembered) > MAX_REMEMBERED_BOOTS:
            oldest = self._remembered.pop(next(iter(self._remembered)))
            self._send_floor = max(self._send_floor, oldest.next_number)
        for channel in hop.data:
            kept = [entry for entry in self._tags[channel.tag] if entry[1] is not hop]
            if kept:
                self._tags[channel.tag] = kept
            else:
                del self._tags[channel.tag]

    def age(self, now: float) -> None:
        for hop in self.hops.values():
            age_together(hop.data, now)
            age_together(hop.hello, now)

    def seal(self, hop: Hop, frame: bytes) -> tuple[int, bytes]:
        """Packet number and relay datagram to this neighbor."""
        number, data = hop.send.seal(frame)
        return number, _MARK + data

    def seal_hello(self, frame: bytes) -> bytes:
        return _MARK + self._to_all.seal_long(frame)[1]

    def open(self, data: bytes | memoryview) -> tuple[bytes, bool, int, bytes]:
        """The sender's boot id, whether it is a hello, its packet number and what it holds. Raises `OpenError` or
        `DecodeError`."""
        inner = memoryview(data)[1:]
        header = parse_header(inner)
        if isinstance(header, LongHeader):
            return self._open_hello(inner, header)
        if header.kind is not Kind.DATA:
            raise DecodeError(f"relay datagram: expected kind 0 or 3, found {header.kind}")
        replayed = False
        for channel, hop in self._tags.get(header.tag, ()):
            try:
                number, frame = channel.open(inner, header.number_low)
            except ReplayError:
                replayed = True
                continue
            except OpenError:
                continue
            return hop.boot_id, False, number, frame
        raise ReplayError("relay datagram: already seen") if replayed else OpenError("relay datagram: of no neighbor")

    def _open_hello(self, inner: memoryview, header: LongHeader) -> tuple[bytes, bool, int, bytes]:
        if header.kind is not Kind.HELLO:
            raise DecodeError(f"relay datagram: expected kind 0 or 3, found {header.kind}")
        place = next((place for place, key in enumerate(self._keys) if key.key_id == header.key_id), None)
        if place is None:
            raise OpenError("relay hello: under an unknown key")
        key = self._keys[place]
        check_long(key, inner, header)
        if header.boot_id == self._own:
            raise ReplayError("relay hello: our own")
        hop = self.hops.get(header.boot_id)
        if hop is not None:
            channel = hop.hello[place]
        else:
            channel = ReceiveChannel(key, header.boot_id, TO_ALL)
            numbers = self._remembered.get(header.boot_id)
            if numbers is not None:
                channel.window.raise_floor(numbers.hello)
        number, frame = channel.open_long(inner, header)
        if hop is None:
            self.add(header.boot_id).hello[place].window.accept(number)
        return header.boot_id, True, number, frame
