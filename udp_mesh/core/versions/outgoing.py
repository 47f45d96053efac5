"""One message for one peer as a version of its topic: how it is encoded is decided when its first fragment is due."""

from __future__ import annotations

from udp_mesh.core.sender.message import OutgoingMessage
from udp_mesh.core.versions.sent import PeerVersions


class OutgoingVersion:
    """Attached to an `OutgoingMessage` of a topic with `delta`."""

    __slots__ = ("_missing", "_peer", "digest", "is_difference", "prepared", "whole")

    def __init__(self, peer: PeerVersions, *, whole: bool = False) -> None:
        self._peer = peer
        self.whole = whole
        """The peer could not decode the difference."""
        self.prepared = False
        """The message's body and flags are those to send."""
        self.digest = b""
        """Its hash; empty while unknown, and if it is sent as an ordinary message."""
        self.is_difference = False
        self._missing: set[int] | None = None
        """Fragments of a best-effort message that are not acknowledged yet."""

    def prepare(self, message: OutgoingMessage, epoch: int, *, accepted: bool, now: float) -> bool:
        """Encode a message that is next to be sent. False if that takes more than a moment: the caller parks it until
        `SentVersions.step` returns it. `epoch` is that of the peer's sender; `accepted`: the peer accepts versions."""
        if not accepted:
            self.prepared = True
            return True
        return self._peer.prepare(message, epoch, now)

    def restarted(self) -> OutgoingVersion:
        """For the same message with nothing sent."""
        return OutgoingVersion(self._peer, whole=self.whole)

    def on_delivered(self, message: OutgoingMessage) -> None:
        """The peer acknowledged the whole message: it has the version."""
        if self.digest:
            self._peer.on_delivered(message, self.digest)

    def on_fragment_arrived(self, message: OutgoingMessage, position: int) -> None:
        """A fragment of a message that already ended was acknowledged: best effort ends when it is sent."""
        if message.reliable or not self.digest:
            return
        if self._missing is None:
            self._missing = {place for place in range(message.fragments) if not message.arrived[place]}
        self._missing.discard(position)
        if not self._missing:
            self.on_delivered(message)

    def on_refused(self, message: OutgoingMessage) -> None:
        """The peer does not have the base, or the whole message, any more."""
        if self.is_difference:
            self.whole = True
            self._peer.on_base_lost(message.accepted.channel)
