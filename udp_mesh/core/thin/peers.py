"""The nodes heard on thin links: frames in, opened items out, of senders that are proven to be alive.

A recorded frame must not count. Each introduction carries, for every node that its sender hears, the tag of the newest
introduction from there: such a frame cannot have been recorded before that one was sent. A boot is *proven* by such a
token, for `PROOF_VALID_S` from when this node sent it; only then, and only with a later counter, are its messages and
acknowledgments accepted. Of two boots with one number the one with the newer token wins; the other one is retired.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

from udp_mesh.crypto import Key, OpenError, ReplayWindow
from udp_mesh.crypto.thin import ThinChannel, thin_hint
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.thin import (
    THIN_TAG_BYTES,
    HeardFrom,
    ThinHeader,
    ThinItem,
    ThinPresence,
    decode_header,
    decode_items,
)

PROOF_VALID_S = 360.0
"""An attacker who holds back all frames can delay a message by this much; twice the longest presence interval."""
MAX_TOKENS = 64
"""Own introductions that are recognized: more than are sent within `PROOF_VALID_S`, except in a storm of new nodes."""
MAX_RETIRED = 16
"""Boots of one number that are never accepted again."""
MISSED_PRESENCES = 3.5
FORGET_S = 3600.0


class Verdict(Enum):
    """The result of opening a frame."""

    ACCEPTED = "accepted"
    UNPROVEN = "unproven"
    """Authentic, but perhaps a recording."""
    FOREIGN = "foreign"
    """Of another fleet, or not openable yet: it says nothing about attacks."""
    REPLAYED = "replayed"
    FORGED = "forged"
    MALFORMED = "malformed"


class ThinBoot:
    """One run of a node's process, as heard here."""

    __slots__ = ("_channels", "met_at", "number", "proof_at", "tag", "token", "token_at", "window")

    def __init__(self, tag: bytes, number: int, now: float) -> None:
        self.tag = tag
        self.number = number
        self.met_at = now
        self.token_at = now
        """When `token` was heard."""
        self.window = ReplayWindow()
        self.token = b""
        """The tag of its newest introduction, which this node's introductions return."""
        self.proof_at = float("-inf")
        """When this node sent the newest token that it returned."""
        self._channels: dict[bytes, ThinChannel] = {}
        """By key id."""

    def is_proven(self, now: float) -> bool:
        return now - self.proof_at <= PROOF_VALID_S

    def open(self, frame: bytes, header: ThinHeader, keys: list[Key], counter: int) -> list[ThinItem]:
        """The items of a frame sealed with one of these keys. Raises `OpenError`, or `DecodeError` for other items."""
        for key in keys:
            channel = self._channels.get(key.key_id)
            if channel is None:
                channel = self._channels[key.key_id] = ThinChannel(key, self.tag, self.number)
            try:
                plain = channel.open(frame, header.length, counter)
            except OpenError:
                continue
            return decode_items(plain)
        raise OpenError("thin frame: cannot be opened")


@dataclass(slots=True, eq=False)
class ThinPeer:
    """A node with its number, heard on thin links."""

    number: int
    name: str
    interval_s: float
    boot: ThinBoot | None = None
    """The proven one."""
    candidate: ThinBoot | None = None
    retired: deque[bytes] = field(default_factory=lambda: deque(maxlen=MAX_RETIRED))
    links: dict[str, float] = field(default_factory=dict)
    """When something authentic was last heard, by link."""
    conflicting_name: str = ""
    """Another name under this number, if one was heard."""

    @property
    def heard_at(self) -> float:
        return max(self.links.values(), default=float("-inf"))

    def is_present(self, now: float) -> bool:
        """Whether it was heard recently and is proven to hear this node."""
        recent = now - self.heard_at <= MISSED_PRESENCES * self.interval_s
        return recent and self.boot is not None and self.boot.is_proven(now)


@dataclass(slots=True)
class Opened:
    """A frame that was opened, or why it was not. `peer` and `items` are set if it could be opened."""

    verdict: Verdict
    peer: ThinPeer | None = None
    items: list[ThinItem] = field(default_factory=list)
    met_at: float | None = None
    """Set if the sender's boot was not known, is not proven, or has just been proven: when it was first heard. An
    introduction sent since then has shown it that it is heard."""
    proven: bool = False
    """The boot has just been proven."""


class ThinPeers:
    """See the module's docstring. `name`, `number` and `boot_tag` are this node's."""

    def __init__(self, keys: tuple[Key, ...], name: str, number: int, boot_tag: bytes) -> None:
        self._name, self._number, self._boot_tag = name, number, boot_tag
        self._hints: list[tuple[int, Key]] = []
        self.set_keys(keys)
        self.peers: dict[int, ThinPeer] = {}
        self.own_number_used_by = ""
        """The name of another node that uses this node's number."""
        self._tokens: OrderedDict[bytes, float] = OrderedDict()

    def set_keys(self, keys: tuple[Key, ...]) -> None:
        """Take over changed keys: what is sealed with another one is foreign from now on."""
        self._hints = [(thin_hint(key), key) for key in keys]

    def on_introduction_sent(self, token: bytes, now: float) -> None:
        """Remember the tag of an own introduction."""
        self._tokens[token] = now
        if len(self._tokens) > MAX_TOKENS:
            self._tokens.popitem(last=False)

    def heard(self, now: float) -> list[HeardFrom]:
        """Tokens for an introduction: boots that are not proven yet first, then those heard most recently."""
        found: list[tuple[bool, float, HeardFrom]] = []
        for peer in self.peers.values():
            for boot in (peer.candidate, peer.boot):
                if boot is not None and now - boot.token_at <= PROOF_VALID_S:
                    found.append((boot is peer.boot, -boot.token_at, HeardFrom(peer.number, boot.token)))
        return [entry for _, _, entry in sorted(found)]

    def present(self, now: float) -> list[ThinPeer]:
        return [peer for peer in self.peers.values() if peer.is_present(now)]

    def named(self, name: str) -> ThinPeer | None:
        return next((peer for peer in self.peers.values() if peer.name == name), None)

    def expire(self, now: float) -> None:
        """Forget boots that are not proven and silent, and nodes that are silent for long."""
        for peer in list(self.peers.values()):
            if peer.candidate is not None and now - peer.candidate.token_at > PROOF_VALID_S:
                peer.candidate = None
            if peer.candidate is None and now - peer.heard_at > FORGET_S:
                del self.peers[peer.number]
            for boot in (peer.boot, peer.candidate):
                if boot is not None:
                    boot.window.age(now)

    def receive(self, frame: bytes, link: str, now: float) -> Opened:
        """Open a frame. Never raises, whatever arrives."""
        try:
            header = decode_header(frame)
        except DecodeError:
            return Opened(Verdict.MALFORMED)
        keys = [key for hint, key in self._hints if hint == header.hint]
        if not keys or header.boot_tag == self._boot_tag:
            return Opened(Verdict.FOREIGN)
        if header.boot_tag is None:
            return self._receive_short(frame, header, keys, link, now)
        return self._receive_introduction(frame, header, header.boot_tag, keys, link, now)

    def _receive_short(self, frame: bytes, header: ThinHeader, keys: list[Key], link: str, now: float) -> Opened:
        peer = self.peers.get(header.number)
        if peer is None:
            return Opened(Verdict.FOREIGN)
        replayed = False
        for boot in (peer.boot, peer.candidate):
            if boot is None:
                continue
            counter = _complete(header.counter_low, boot.window.next_new)
            if not boot.window.would_accept(counter):
                # It may be a new frame of the other boot.
                replayed = True
                continue
            try:
                items = boot.open(frame, header, keys, counter)
            except OpenError:
                continue
            except DecodeError:
                return Opened(Verdict.MALFORMED)
            boot.window.accept(counter)
            if boot is not peer.boot or not boot.is_proven(now):
                return Opened(Verdict.UNPROVEN, peer, met_at=boot.met_at)
            peer.links[link] = now
            return Opened(Verdict.ACCEPTED, peer, items)
        return Opened(Verdict.REPLAYED if replayed else Verdict.FORGED)

    def _receive_introduction(
        self, frame: bytes, header: ThinHeader, boot_tag: bytes, keys: list[Key], link: str, now: float
    ) -> Opened:
        peer = self.peers.get(header.number)
        known = () if peer is None else (peer.boot, peer.candidate)
        boot = next((boot for boot in known if boot is not None and boot.tag == boot_tag), None)
        is_new = boot is None
        boot = boot or ThinBoot(boot_tag, header.number, now)
        counter = (header.counter_high or 0) << 16 | header.counter_low
        if (peer is not None and boot_tag in peer.retired) or not boot.window.would_accept(counter):
            return Opened(Verdict.REPLAYED)
        try:
            items = boot.open(frame, header, keys, counter)
        except OpenError:
            return Opened(Verdict.FORGED)
        except DecodeError:
            return Opened(Verdict.MALFORMED)
        presence = next((item for item in items if isinstance(item, ThinPresence)), None)
        if presence is None:
            return Opened(Verdict.MALFORMED)
        if header.number == self._number:
            if presence.name != self._name:
                self.own_number_used_by = presence.name
            return Opened(Verdict.FOREIGN)
        if peer is None:
            peer = self.peers[header.number] = ThinPeer(header.number, presence.name, float(presence.interval_s))
        if is_new:
            peer.candidate = boot
        boot.window.accept(counter)
        boot.token, boot.token_at = bytes(frame[-THIN_TAG_BYTES:]), now
        proof_at = self._proof_at(presence.heard)
        proven = False
        if boot is peer.boot:
            proven = not boot.is_proven(now) and now - proof_at <= PROOF_VALID_S
            boot.proof_at = max(boot.proof_at, proof_at)
        elif now - proof_at <= PROOF_VALID_S and (peer.boot is None or proof_at > peer.boot.proof_at):
            if peer.boot is not None:
                peer.retired.append(peer.boot.tag)
                peer.conflicting_name = peer.name if peer.name != presence.name else ""
            boot.proof_at = proof_at
            peer.boot, peer.candidate, proven = boot, None, True
            # What was recorded before the proof stays out.
            boot.window.raise_floor(counter)
        if boot is not peer.boot or not boot.is_proven(now):
            return Opened(Verdict.UNPROVEN, peer, met_at=boot.met_at)
        peer.links[link] = now
        peer.name, peer.interval_s = presence.name, max(1.0, float(presence.interval_s))
        return Opened(Verdict.ACCEPTED, peer, items, boot.met_at if proven else None, proven)

    def _proof_at(self, heard: Iterable[HeardFrom]) -> float:
        """When this node sent the newest of its tokens among these; never, if none is known."""
        tokens = [entry.token for entry in heard if entry.number == self._number]
        return max((self._tokens.get(token, float("-inf")) for token in tokens), default=float("-inf"))


def _complete(low: int, expected: int) -> int:
    """The counter with these low 16 bits that is nearest to the expected one (RFC 9000, appendix A.3)."""
    counter = expected & ~0xFFFF | low
    if counter + 0x8000 <= expected:
        return counter + 0x10000
    if counter > expected + 0x8000 and counter >= 0x10000:
        return counter - 0x10000
    return counter
