"""Proves that a peer answers at an address before anything is sent there for good (as RFC 9000, 8.2 and 9).

1. A datagram came from another address, or may be a recording: a ping with a random token goes to where it came from,
   and one to the address in use.
2. The pong of the first, from that address, proves it. An attacker that only repeats what it overheard cannot make one.
3. Where the address in use answers too, it stays in use, also when its answer is the later one: the other may be
   somebody who passes everything on (RFC 9000, 9.3.3).
"""

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.peers.session import CHALLENGE_TIMEOUT_S, Challenge, Session
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Frame, Ping, Pong

CHALLENGE_INTERVAL_S = 0.25
"""Between two questions to one peer: as often as a silent peer is probed, so that a flood of copies makes few pings."""

MAX_CHALLENGES = 8
"""Questions remembered per peer: four addresses at a time, each with the one in use."""


def validate_path(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """Ask whether the peer is at this address, and whether it still is where it was."""
    if session.peer is None or now < session.challenged_at + CHALLENGE_INTERVAL_S:
        return
    session.challenged_at = now
    path = session.path
    elsewhere = path.link in state.links and (path.link, path.address) != (link, source)
    if elsewhere:
        _send_challenge(state, session, Challenge(path.link, path.address, now, in_use=True))
    _send_challenge(state, session, Challenge(link, source, now, in_use=not elsewhere))


def _send_challenge(state: State, session: Session, challenge: Challenge) -> None:
    token = state.rng.getrandbits(64)
    session.challenges[token] = challenge
    while len(session.challenges) > MAX_CHALLENGES:
        del session.challenges[next(iter(session.challenges))]
    send_on_path(state, session, Ping(token), challenge.link, challenge.address, challenge.sent_at)


def send_on_path(state: State, session: Session, frame: Frame, link: str, address: Address, now: float) -> None:
    """One small frame to this address, whatever the way in use."""
    number, data = session.path.seal(encode(session.path.with_timestamp([frame], now)))
    if session.is_current and session.peer is not None:
        session.peer.sender.in_flight.add(number, None)
    state.outgoing.append(Datagram(link, address, data, True))


def match_response(session: Session, pong: Pong, link: str, source: Address, now: float) -> Challenge | None:
    """The question that this pong answers, if it came from where that went."""
    challenge = session.challenges.get(pong.token)
    if challenge is None or (challenge.link, challenge.address) != (link, source):
        return None
    del session.challenges[pong.token]
    return challenge if now - challenge.sent_at <= CHALLENGE_TIMEOUT_S else None
