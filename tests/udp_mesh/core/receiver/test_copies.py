"""A copy of an urgent fragment that arrived before is acknowledged with the next packets, not at once."""

from __future__ import annotations

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.settings import Topic


def test_a_copy_that_brings_nothing_new_is_not_acknowledged_at_once() -> None:
    both = pair(Topic("stop", priority=0))
    sender = both.a._state.peer_table.peers["b"].open_sender()
    both.a.send("stop", b"before", destination="b", now=both.now)
    both.roundtrip(times=5)
    sender.loss.send_twice = True
    both.a.send("stop", b"now", destination="b", now=both.now)

    def deliver() -> int:
        datagrams = both.leave(both.a)
        for datagram in datagrams:
            both.b.receive(datagram.data, "mesh", ("10.0.0.1", 8700), both.now)
        return len(datagrams)

    assert deliver() == 1
    assert len(both.drop(both.b)) == 1
    both.now += sender.rates.twice_gap_s + 0.0001
    # The early copy, and, as there is no round trip, the one for the overdue answer.
    assert deliver() == 2
    assert both.leave(both.b) == []
    both.now += sender.rates.ack_delay_s
    assert len(both.leave(both.b)) == 1
