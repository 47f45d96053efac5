"""Checks whether an opened datagram may be replayed: by its timestamp, by recent traffic, and by answers to challenges.

1. A datagram with a timestamp is as late as its sender's clock says (`datagram_age`).
2. One without a timestamp (a fragment in the middle of a message) counts as fresh while its sender sent something fresh
   recently; after that the sender is challenged. After a silence, one that is known to be fresh comes first: lower
   numbers may be from before the silence.
3. A datagram that is too late is dropped and its sender challenged (`path_validation`): the answer proves that it is
   there and corrects its clock. Pings are answered however late they are.
"""

from collections.abc import Sequence

from udp_mesh.core.peer_lifecycle import on_path_validated
from udp_mesh.core.peers.first_contact import challenge_contact
from udp_mesh.core.peers.path_validation import answer_pings, match_response, validate_path
from udp_mesh.core.peers.session import Session
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, CHALLENGE_AFTER_S
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.codec import SENT_BYTES, Type, decode
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.fragment import FRAGMENT
from udp_mesh.wire.frames import Frame, Heartbeat, Pong, Sent


def data_lateness_s(
    state: State, session: Session, frames: bytes, link: str, source: Address, now: float
) -> float | None:
    """Seconds by which a datagram between two boots was delayed. None: drop it."""
    clock = timestamp_of(frames)
    if session.challenges and has_response(state, session, small_frames(frames), clock, link, source, now):
        return 0.0
    if not session.timed:
        return 0.0
    if clock is not None:
        late_s = session.freshness.lateness_s(clock, now)
        if late_s <= ACCEPT_AGE_S:
            return late_s
    else:
        undated_s = now - session.freshness.fresh_at
        if undated_s > CHALLENGE_AFTER_S:
            validate_path(state, session, link, source, now)
        if undated_s <= ACCEPT_AGE_S and not session.freshness.data_resumed:
            return 0.0
    drop_stale(state, session, small_frames(frames), link, source, now)
    return None


def small_frames(frames: bytes) -> list[Frame]:
    """The frames of a datagram that may hold a ping or a pong; none if they are malformed (counted later)."""
    if not frames or frames[0] >= FRAGMENT:
        return []
    try:
        return decode(frames)
    except DecodeError:
        return []


def long_lateness_s(
    state: State, session: Session, frames: Sequence[Frame], link: str, source: Address, now: float
) -> float | None:
    """The same for a HELLO or an INTRODUCTION; without a timestamp, as from earlier versions, it is accepted."""
    clock = clock_of(frames)
    if has_response(state, session, frames, clock, link, source, now):
        return 0.0
    late_s = 0.0 if clock is None else session.freshness.lateness_s(clock, now)
    if late_s <= ACCEPT_AGE_S:
        return late_s
    drop_stale(state, session, frames, link, source, now)
    return None


def clock_of(frames: Sequence[Frame]) -> int | None:
    """The sender's clock in a datagram's frames, if they have one."""
    clock = None
    for frame in frames:
        if isinstance(frame, Sent) or (isinstance(frame, Heartbeat) and frame.clock_ms is not None):
            clock = frame.clock_ms
    return clock


def broadcast_lateness_s(
    state: State, session: Session, frames: bytes, link: str, source: Address, now: float
) -> float | None:
    """The same for a broadcast. Without a timestamp, which some peers do not accept, only its number decides:
    heartbeats are numbered in the same channel."""
    clock = timestamp_of(frames)
    late_s = 0.0 if clock is None else session.freshness.lateness_s(clock, now)
    is_undecided = clock is None and session.timed and session.freshness.broadcasts_resumed
    if late_s <= ACCEPT_AGE_S and not is_undecided:
        return late_s
    drop_stale(state, session, (), link, source, now)
    return None


def on_fresh_data(session: Session, number: int, now: float) -> None:
    """A datagram with this number is fresh. After a silence, lower numbers may be from before it."""
    if session.freshness.data_resumed and session.timed:
        for channel in session.data_channels:
            channel.window.raise_floor(number)
        session.freshness.on_data_floor(now)


def on_fresh_broadcast(session: Session, number: int) -> None:
    """The same for a broadcast."""
    if session.freshness.broadcasts_resumed and session.timed:
        for channel in session.broadcast_channels:
            channel.window.raise_floor(number)
        session.freshness.broadcasts_resumed = False


def timestamp_of(frames: bytes) -> int | None:
    """The timestamp at the front of a datagram, if it has one."""
    if frames[0] != Type.SENT or len(frames) < SENT_BYTES:
        return None
    return int.from_bytes(frames[1:SENT_BYTES], "big")


def drop_stale(state: State, session: Session, frames: Sequence[Frame], link: str, source: Address, now: float) -> None:
    """Drop a replayed datagram, or one whose sender's clock stood still (its computer was suspended): the answer to the
    challenge shows which."""
    state.event_queue.counters.dropped_stale += 1
    answer_pings(state, session, frames, link, source, now)
    if session.verified:
        validate_path(state, session, link, source, now)
    else:
        challenge_contact(state, session, link, source, now)


def has_response(
    state: State,
    session: Session,
    frames: Sequence[Frame],
    clock: int | None,
    link: str,
    source: Address,
    now: float,
) -> bool:
    """Whether a frame answers a challenge from the challenged address: then all of the frames are fresh."""
    for frame in frames:
        if isinstance(frame, Pong):
            challenge = match_response(session, frame, link, source, now)
            if challenge is not None:
                session.freshness.confirm(now, clock)
                on_path_validated(state, session, challenge, now)
                return True
    return False
