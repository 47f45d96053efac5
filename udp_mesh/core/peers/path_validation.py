"""Path validation (RFC 9000, 8.2 and 9): proves that a peer answers at an address before it is used.

1. When a datagram comes from another address, or may be replayed, a ping with a random token is sent to its source, and
   one to the current address.
2. The pong from that source validates the path. An attacker that only replays recorded datagrams cannot produce one.
3. If the current address answers too, it stays in use, even if its answer is the later one: the other may be an on-path
   attacker that forwards everything (RFC 9000, 9.3.3).
"""

from collections.abc import Sequence

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers.session import CHALLENGE_TIMEOUT_S, Challenge, Session
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Frame, Ping, Pong

CHALLENGE_INTERVAL_S = 0.25
"""Minimum time between two challenges of a peer, equal to the probe interval: a flood of copies causes few pings."""

MAX_CHALLENGES = 8
"""Challenges remembered per peer: four addresses at a time, each with the current one."""


def validate_path(
    state: State, session: Session, link: str, source: Address, now: float, *, better: bool = False
) -> None:
    """Challenge this address and the current one, unless the new one is `better` even if both answer."""
    if session.peer is None or now < session.challenged_at + CHALLENGE_INTERVAL_S:
        return
    session.challenged_at = now
    path = session.path
    migrating = path.link in state.links and (path.link, path.address) != (link, source) and not better
    if migrating:
        _send_challenge(state, session, Challenge(path.link, path.address, now, in_use=True))
    _send_challenge(state, session, Challenge(link, source, now, in_use=not migrating))


def _send_challenge(state: State, session: Session, challenge: Challenge) -> None:
    token = add_challenge(state, session, challenge)
    send_on_path(state, session, [Ping(token)], challenge.link, challenge.address, challenge.sent_at)


def add_challenge(state: State, session: Session, challenge: Challenge) -> int:
    """Remember a challenge; returns the token of its ping."""
    token = state.rng.getrandbits(64)
    session.challenges[token] = challenge
    while len(session.challenges) > MAX_CHALLENGES:
        del session.challenges[next(iter(session.challenges))]
    return token


def send_on_path(state: State, session: Session, frames: list[Frame], link: str, address: Address, now: float) -> None:
    """Send small frames to this address, regardless of the current path."""
    number, data = session.path.seal(encode(session.path.with_timestamp(frames, now)))
    if session.is_current and session.peer is not None:
        session.peer.open_sender().in_flight.add(number, None)
    state.outgoing.append(Datagram(link, address, data, True))


def answer_pings(
    state: State, session: Session, frames: Sequence[Frame], link: str, source: Address, now: float
) -> None:
    """Answer the pings of a datagram that has no other effect, or not yet: its sender may not believe us without."""
    for frame in frames:
        if isinstance(frame, Ping):
            send_on_path(state, session, [Pong(frame.token, 0)], link, source, now)


def match_response(session: Session, pong: Pong, link: str, source: Address, now: float) -> Challenge | None:
    """The challenge answered by this pong, if it came from the challenged address, and in time.

    A first contact must answer within `ACCEPT_AGE_S`: the clock in its answer is the reference for all that follows.
    """
    challenge = session.challenges.get(pong.token)
    if challenge is None or (challenge.link, challenge.address) != (link, source):
        return None
    del session.challenges[pong.token]
    timeout_s = CHALLENGE_TIMEOUT_S if session.verified else ACCEPT_AGE_S
    return challenge if now - challenge.sent_at <= timeout_s else None
