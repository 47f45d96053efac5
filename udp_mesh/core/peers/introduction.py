"""Introductions: the heartbeat that a datagram begins with whose receiver may not know our current boot yet."""

from udp_mesh.core.peers.heartbeat import own_features
from udp_mesh.core.peers.session import Session
from udp_mesh.core.receiver.datagram_age import clock_echo, clock_ms
from udp_mesh.core.state import State
from udp_mesh.wire.frames import Heartbeat
from udp_mesh.wire.header import VERSION


def introduction(state: State, session: Session, now: float) -> Heartbeat:
    """The heartbeat to this session alone."""
    settings = state.settings
    return Heartbeat(
        settings.name,
        VERSION,
        VERSION,
        own_features(settings),
        min(65_535, int(settings.rates.heartbeat_sparse_s * 1000)),
        0,
        0,
        state.broadcast_channel.next_number,
        state.broadcasts.next_number,
        (session.heard_tag,),
        (),
        clock_ms(now),
        () if session.clock_ms is None else (clock_echo(session.clock_ms),),
    )
