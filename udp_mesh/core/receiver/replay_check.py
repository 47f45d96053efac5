"""Whether an opened datagram may be a recording: its date, what came lately beside it, and answers to our questions.

1. A dated datagram is as late as its sender's clock says (`freshness`).
2. One without a date (a piece in the middle of a message) is taken for as fresh as what came lately from its sender;
   where that becomes long ago, the sender is asked.
3. What is too late is dropped, and its sender asked (`paths`): an answer proves that it is there, and sets its clock
   right. Questions are answered however late they are.
"""

from collections.abc import Sequence

from udp_mesh.core.peer_lifecycle import on_path_validated
from udp_mesh.core.peers.path_validation import match_response, send_on_path, validate_path
from udp_mesh.core.peers.session import Session
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, CHALLENGE_AFTER_S
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.codec import FRAGMENT, SENT_BYTES, Type, decode
from udp_mesh.wire.errors import DecodeError
from udp_mesh.wire.frames import Frame, Heartbeat, Ping, Pong, Sent


def data_lateness_s(
    state: State, session: Session, frames: bytes, link: str, source: Address, now: float
) -> float | None:
    """Seconds for which a datagram in the channel between two boots was held back; None: it must not be taken."""
    clock = timestamp_of(frames)
    if session.challenges and _has_response(state, session, _small_frames(frames), clock, link, source, now):
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
        if undated_s <= ACCEPT_AGE_S:
            return 0.0
    drop_stale(state, session, _small_frames(frames), link, source, now)
    return None


def _small_frames(frames: bytes) -> list[Frame]:
    """The frames of a datagram that may hold a ping or a pong; none where they are malformed (counted later)."""
    if frames[0] >= FRAGMENT:
        return []
    try:
        return decode(frames)
    except DecodeError:
        return []


def long_lateness_s(
    state: State, session: Session, frames: Sequence[Frame], link: str, source: Address, now: float
) -> float | None:
    """The same of a hello or an introduction; without a date, as earlier versions send it, it is taken."""
    clock = None
    for frame in frames:
        if isinstance(frame, Sent) or (isinstance(frame, Heartbeat) and frame.clock_ms is not None):
            clock = frame.clock_ms
    if _has_response(state, session, frames, clock, link, source, now):
        return 0.0
    late_s = 0.0 if clock is None else session.freshness.lateness_s(clock, now)
    if late_s <= ACCEPT_AGE_S:
        return late_s
    drop_stale(state, session, frames, link, source, now)
    return None


def broadcast_lateness_s(
    state: State, session: Session, frames: bytes, link: str, source: Address, now: float
) -> float | None:
    """The same of a message to all; without a date, as it is where some node takes none, its number alone decides: the
    heartbeats are numbered in the same channel."""
    clock = timestamp_of(frames)
    late_s = 0.0 if clock is None else session.freshness.lateness_s(clock, now)
    if late_s <= ACCEPT_AGE_S:
        return late_s
    drop_stale(state, session, (), link, source, now)
    return None


def timestamp_of(frames: bytes) -> int | None:
    """The clock in the first frame of a datagram, where its date stands."""
    if frames[0] != Type.SENT or len(frames) < SENT_BYTES:
        return None
    return int.from_bytes(frames[1:SENT_BYTES], "big")


def drop_stale(state: State, session: Session, frames: Sequence[Frame], link: str, source: Address, now: float) -> None:
    """A recording; or its sender's clock stood still (its computer slept), and then its answer says so."""
    state.event_queue.counters.dropped_stale += 1
    for frame in frames:
        if isinstance(frame, Ping) and session.peer is not None:
            send_on_path(state, session, Pong(frame.token, 0), link, source, now)
    validate_path(state, session, link, source, now)


def _has_response(
    state: State,
    session: Session,
    frames: Sequence[Frame],
    clock: int | None,
    link: str,
    source: Address,
    now: float,
) -> bool:
    """Whether one of the frames answers a question of ours from where that went: then all of them are fresh."""
    for frame in frames:
        if isinstance(frame, Pong):
            challenge = match_response(session, frame, link, source, now)
            if challenge is not None:
                session.freshness.confirm(now, clock)
                on_path_validated(state, session, challenge, now)
                return True
    return False
