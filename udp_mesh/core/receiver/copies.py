"""Copies of datagrams that have come before: authentic copy -> the path that it came over works.

A relay without the key may forward everything and be faster than the path: then all that comes over the path has come
before. Such copies have no effect, but they keep the path (RFC 9000, 9.3.3), and pings and pongs among them count,
because their first copies belong to the relay's address.
"""

from udp_mesh.core.peers.path_validation import answer_pings
from udp_mesh.core.peers.session import STALE_PATH_S, Session
from udp_mesh.core.receiver.replay_check import clock_of, has_response, small_frames
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.crypto import OpenError, ReceiveChannel

COPY_INTERVAL_S = 0.02
"""Minimum time between two copies of a peer that are opened, so that a flood of them costs little."""


def on_copy(
    state: State,
    session: Session,
    channel: ReceiveChannel,
    data: bytes | memoryview,
    link: str,
    source: Address,
    now: float,
) -> None:
    """A datagram whose number has come before in this channel, if it is authentic and recent."""
    if not session.verified or now < session.copy_opened_at + COPY_INTERVAL_S:
        return
    session.copy_opened_at = now
    try:
        frames = small_frames(channel.open_copy(data))
    except OpenError:
        return
    clock = clock_of(frames)
    if clock is None or session.freshness.late_by_s(clock, now) > STALE_PATH_S:
        return
    if (link, source) == (session.path.link, session.path.address):
        session.path.heard_at = now
    if not has_response(state, session, frames, clock, link, source, now):
        answer_pings(state, session, frames, link, source, now)
