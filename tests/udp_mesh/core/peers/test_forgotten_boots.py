"""A node that forgot a boot which it had verified still refuses recordings of it."""

from tests.udp_mesh.core.pair import KEY, pair
from udp_mesh.crypto import SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Heartbeat
from udp_mesh.wire.limits import HEARD_TAG_BYTES

SOURCE = ("10.0.0.66", 8700)


def test_a_recorded_hello_of_a_forgotten_boot_is_a_replay() -> None:
    both = pair()
    state, boot = both.a._state, bytes(range(16))
    channel = SendChannel(KEY, boot)
    beat = Heartbeat("ghost", 1, 1, 0, 1000, 0, 0, 0, 0, (state.boot_id[:HEARD_TAG_BYTES],))
    first, second = (channel.seal_long(encode([beat]))[1] for _ in range(2))
    both.a.receive(first, "mesh", SOURCE, both.now)
    assert state.peer_table.sessions[boot].verified
    state.peer_table.forget(state.peer_table.sessions[boot])
    both.a.receive(first, "mesh", SOURCE, both.now)
    assert both.a.conditions(both.now).counters.dropped_replayed == 1
    assert boot not in state.peer_table.sessions
    both.a.receive(second, "mesh", SOURCE, both.now)
    assert boot in state.peer_table.sessions
