"""The first contact with a boot: it proves that it is there now before anything from it takes effect.

The age of a recorded datagram is known only by comparison with an earlier one of its boot (`datagram_age`); for the
first ones of a boot that was never heard there is none. A capable peer therefore proves its first contact:

1. Its heartbeat that lists us echoes our clock from the newest heartbeat of ours that it heard: if that was sent
   recently, so was the heartbeat (`proves_contact`). This takes no additional datagram.
2. If there is no such echo (an earlier version, a heartbeat that answers nothing), it is challenged with a ping
   (`challenge_contact`), and what it sent to us is held until its pong.

A peer that sends no timestamps is believed at once: its recordings cannot be distinguished anyway.
"""

from collections.abc import Sequence

from udp_mesh.core.peers.introduction import introduction
from udp_mesh.core.peers.path_validation import CHALLENGE_INTERVAL_S, add_challenge, answer_pings, send_on_path
from udp_mesh.core.peers.session import Challenge, HeldDatagram, Session
from udp_mesh.core.receiver.datagram_age import ACCEPT_AGE_S, echo_age_s
from udp_mesh.core.settings import Address
from udp_mesh.core.state import State
from udp_mesh.wire.frames import Frame, Heartbeat, Ping
from udp_mesh.wire.limits import HEARD_TAG_BYTES

MAX_HELD_DATAGRAMS = 8
"""Datagrams held per boot until its first contact is proven: a round trip of introductions and a first burst. The
others are retransmitted."""


def needs_proof(session: Session) -> bool:
    """Whether datagrams of this boot may be recordings whose age is unknown."""
    return session.timed and not session.freshness.confirmed


def proves_contact(state: State, session: Session, beat: Heartbeat, now: float) -> bool:
    """Whether a heartbeat shows that its sender heard us at most `ACCEPT_AGE_S` ago, or needs not to."""
    if not needs_proof(session):
        return True
    listed = beat.heard[: len(beat.heard_clocks)]
    own_tag = state.boot_id[:HEARD_TAG_BYTES]
    return own_tag in listed and echo_age_s(beat.heard_clocks[listed.index(own_tag)], now) <= ACCEPT_AGE_S


def challenge_contact(state: State, session: Session, link: str, source: Address, now: float) -> None:
    """Send a ping to this address, introduced because the boot may not know ours."""
    if now < session.challenged_at + CHALLENGE_INTERVAL_S or link not in state.links:
        return
    session.challenged_at = now
    in_use = (session.path.link, session.path.address) == (link, source)
    token = add_challenge(state, session, Challenge(link, source, now, in_use))
    send_on_path(state, session, [introduction(state, session, now), Ping(token)], link, source, now)


def hold(state: State, session: Session, datagram: HeldDatagram, frames: Sequence[Frame], now: float) -> None:
    """Keep a datagram until the first contact is proven, and challenge its sender. Without room it counts as lost.

    A ping among its `frames` is answered at once: its sender may wait for our proof as we do for its own.
    """
    session.last_heard = now
    if len(session.held) < MAX_HELD_DATAGRAMS:
        session.held.append(datagram)
    answer_pings(state, session, frames, datagram.link, datagram.source, now)
    challenge_contact(state, session, datagram.link, datagram.source, now)
