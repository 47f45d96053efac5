"""The channels of boots of which nothing was opened yet: a long header in -> its channel out, derived once.

A recorded header passes its check, whatever an attacker appends to it. Deriving keys for each such datagram would cost
four times as much as finding out that it cannot be opened.
"""

from udp_mesh.crypto import TO_ALL, Key, ReceiveChannel
from udp_mesh.wire.header import Kind, LongHeader

MAX_BOOTS = 16
"""An attacker has only the headers that were recorded; one who rotates more boots pays for the derivation as before."""


class UnknownBoots:
    """At most `MAX_BOOTS` channels, the oldest of which makes room for a new one."""

    __slots__ = ("_boot_id", "_channels")

    def __init__(self, boot_id: bytes) -> None:
        """`boot_id` is this node's."""
        self._boot_id = boot_id
        self._channels: dict[tuple[bytes, bytes, Kind], ReceiveChannel] = {}

    def __len__(self) -> int:
        return len(self._channels)

    def channel(self, key: Key, header: LongHeader) -> ReceiveChannel:
        """The channel of the header's boot under this key, to this node or to all."""
        place = (key.key_id, header.boot_id, header.kind)
        channel = self._channels.get(place)
        if channel is None:
            if len(self._channels) >= MAX_BOOTS:
                del self._channels[next(iter(self._channels))]
            introduced = header.kind is Kind.INTRODUCTION
            channel = ReceiveChannel(key, header.boot_id, self._boot_id if introduced else TO_ALL)
            self._channels[place] = channel
        return channel

    def forget(self, key: Key, header: LongHeader) -> None:
        """Something of this boot was opened: a session has channels of its own."""
        self._channels.pop((key.key_id, header.boot_id, header.kind), None)
