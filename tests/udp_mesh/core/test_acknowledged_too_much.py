"""An acknowledgment of packets that were never sent, by a faulty peer, changes nothing."""

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.frame_handlers import process_frames
from udp_mesh.wire.frames import Ack

RATE = 12_345


def test_it_confirms_no_path_and_reports_no_rate() -> None:
    both = pair()
    both.roundtrip()
    (session,) = both.a._state.peer_table.sessions.values()
    path, reception = session.path, session.reception
    path.confirmed = False
    beyond = Ack(path.channel.next_number, 0, 0, RATE)
    process_frames(both.a._state, session, [beyond], 1000, path.link, path.address, both.now)
    assert (path.confirmed, session.reception) == (False, reception)
    assert session.peer_receives[0] != RATE
