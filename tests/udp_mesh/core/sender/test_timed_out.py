"""Fragments whose acknowledgments stay away are sent again, whatever the scheduler held when they timed out."""

from __future__ import annotations

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.settings import Topic
from udp_mesh.wire.fragment import HEAD_BYTES


def test_fragments_that_time_out_twice_are_sent_again_although_the_last_batch_ended_with_them() -> None:
    """A batch that ends with the last waiting fragment leaves its level marked as waiting until the next one."""
    both = pair(Topic("map", priority=7))
    both.a.send("map", bytes(200_000), destination="b", now=both.now)
    both.roundtrip(times=100, step_s=0.002)
    both.events(both.a)
    peer = both.a._state.peer_table.peers["b"]
    sender = peer.open_sender()
    assert peer.session is not None
    # Full fragments only: one with room left would look for more to share its datagram with.
    payload = bytes(8 * peer.session.path.fragment_bytes - HEAD_BYTES)
    both.a.send("map", payload, destination="b", now=both.now)
    size = sum(len(datagram.data) for datagram in both.drop(both.a) if not datagram.urgent)

    def wait_for_timeout(packets: int) -> None:
        while sender.in_flight.outstanding == packets:
            both.now += 0.001
            both.a.handle_timer(both.now)

    sent = sender.in_flight.outstanding
    wait_for_timeout(sent)
    assert sender.scheduler.waiting
    both.a.datagrams_to_send(both.now, max_bytes=size - 1)
    assert (sender.in_flight.outstanding, bool(sender.scheduler.waiting)) == (sent, True)
    wait_for_timeout(sent)
    assert (sender.state, sender.in_flight.outstanding) == (SendState.TIMING_OUT, 0)
    both.roundtrip(times=100)
    assert [type(event) for event in both.events(both.a)] == [MessageDelivered]
