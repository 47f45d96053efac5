"""Features that peers accept: whether one may be used, and messages without those that a receiver does not accept."""

from __future__ import annotations

from collections.abc import Sequence

from udp_mesh.core.peers.heartbeat import own_features
from udp_mesh.core.peers.session import Session
from udp_mesh.core.sender.message import AcceptedMessage
from udp_mesh.core.state import State
from udp_mesh.core.thin.numbering import unnumbered
from udp_mesh.wire.frames import Feature, MessageFlag


def all_accept(state: State, names: Sequence[str], feature: int) -> bool:
    """Whether these peers (none: all that are online) accept a feature, as far as they are known."""
    peers = [state.peer_table.peers.get(name) for name in names] if names else state.peer_table.online()
    sessions = [peer.session for peer in peers if peer is not None and peer.session is not None]
    return bool(own_features(state.settings) & feature) and all(session.features & feature for session in sessions)


def acceptable(accepted: AcceptedMessage, session: Session) -> AcceptedMessage:
    """The message as it is, or without what the peer does not accept: its number, its compression."""
    if not session.features & Feature.THIN:
        accepted = unnumbered(accepted)
    needed = Feature.ZSTD if accepted.flags & MessageFlag.ZSTD else Feature.ZLIB
    return accepted if session.features & needed else uncompressed(accepted)


def uncompressed(accepted: AcceptedMessage) -> AcceptedMessage:
    """The message as it was accepted."""
    if not accepted.flags & MessageFlag.COMPRESSED:
        return accepted
    flags = accepted.flags & ~(MessageFlag.COMPRESSED | MessageFlag.ZSTD)
    return accepted._replace(body=accepted.payload, flags=flags)
