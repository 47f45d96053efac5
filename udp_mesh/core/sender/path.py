"""The path to a peer: its link, its address, what fits a datagram, and how datagrams are sealed."""

from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.settings import Address
from udp_mesh.crypto import LONG_OVERHEAD_BYTES, SHORT_OVERHEAD_BYTES, SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.fragment import FRAGMENT_WIDE_BYTES
from udp_mesh.wire.frames import Frame, Sent

IP_UDP_BYTES = 28
"""IPv4 and UDP headers."""

IP6_EXTRA_BYTES = 20
"""Additional size of an IPv6 header."""


def header_bytes(address: Address) -> int:
    """Size of the IP and UDP headers of a datagram to or from this address."""
    return IP_UDP_BYTES + (IP6_EXTRA_BYTES if ":" in address[0] else 0)


def datagram_room(address: Address, mtu: int, fragment_bytes: int) -> int:
    """Bytes of frames that fit a datagram in an IP packet of `mtu` bytes, at most those of one full fragment."""
    return min(mtu - header_bytes(address) - LONG_OVERHEAD_BYTES, fragment_bytes + FRAGMENT_WIDE_BYTES)


class Path:
    """The path to the peer: link, address, sealing and sizes."""

    __slots__ = (
        "address",
        "channel",
        "compact",
        "confirmed",
        "confirms",
        "fragment_bytes",
        "heard_at",
        "link",
        "mtu",
        "room_bytes",
        "timed",
        "versions",
    )

    def __init__(self, channel: SendChannel) -> None:
        self.channel = channel
        self.confirmed = False
        """The peer has answered in this channel, so the short header suffices."""
        self.link = ""
        self.address: Address = ("", 0)
        self.heard_at = float("-inf")
        """When the peer was last heard from this address."""
        self.mtu = 0
        """Largest IP packet in bytes."""
        self.room_bytes = 0
        """Largest size of a datagram's frames. Small fragments that share a datagram make it no larger than a full
        fragment does."""
        self.fragment_bytes = 0
        """Payload of a full fragment."""
        self.compact = False
        """The peer accepts compact fragments."""
        self.timed = False
        """The peer accepts timestamped datagrams and message heads with a remaining lifetime."""
        self.confirms = False
        """The peer confirms messages that ask for it."""
        self.versions = False
        """The peer keeps versions and accepts differences to them."""

    def switch_to(self, link: str, address: Address, mtu: int, fragment_bytes: int) -> None:
        """Use this path from now on. Messages already started keep their fragments if these still fit."""
        self.link, self.address, self.mtu = link, address, mtu
        self.room_bytes = datagram_room(address, mtu, fragment_bytes)
        self.fragment_bytes = self.room_bytes - FRAGMENT_WIDE_BYTES

    def with_timestamp(self, frames: list[Frame], now: float) -> list[Frame]:
        """The frames, preceded by a timestamp if the peer accepts it.

        The timestamp is not part of `room_bytes`, which leaves room for the long header: that is larger than the short
        one by more than a timestamp and a remaining lifetime. With a long header, both are omitted if they do not fit.
        """
        return [Sent(clock_ms(now)), *frames] if self.timed else frames

    def encode(self, frames: list[Frame], now: float) -> bytes:
        """The encoded frames, with a timestamp if it fits the path."""
        encoded = encode(self.with_timestamp(frames, now), compact=self.compact)
        return encoded if self.confirmed or len(encoded) <= self.room_bytes else encode(frames, compact=self.compact)

    def seal(self, frames: bytes) -> tuple[int, bytes]:
        return self.channel.seal(frames) if self.confirmed else self.channel.seal_long(frames)

    def seal_run(self, run: list[bytes]) -> list[bytes]:
        """Seal datagrams under the channel's next numbers."""
        if self.confirmed:
            return self.channel.seal_run(run)
        return [self.channel.seal_long(frames)[1] for frames in run]

    @property
    def overhead_bytes(self) -> int:
        return SHORT_OVERHEAD_BYTES if self.confirmed else LONG_OVERHEAD_BYTES
