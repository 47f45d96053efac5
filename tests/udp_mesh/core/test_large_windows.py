"""More packets may arrive at once, or be overtaken, than an acknowledgment covers: none of them counts as lost."""

from tests.udp_mesh.core.pair import Pair, pair
from udp_mesh.core.events import MessageDelivered
from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import Rates, Topic
from udp_mesh.wire.limits import ACK_BITMAP_BITS

TOPICS = (Topic("stop", priority=0), Topic("map", priority=8))


def leave_large(both: Pair) -> list[Datagram]:
    """`a` sends more full datagrams at once than a bitmap covers."""
    both.a.send("map", bytes(2 * ACK_BITMAP_BITS * 1000), destination="b", now=both.now)
    bulk = both.leave(both.a)
    assert len(bulk) > ACK_BITMAP_BITS + 64
    return bulk


def receive(both: Pair, datagrams: list[Datagram]) -> None:
    for datagram in datagrams:
        both.b.receive(datagram.data, "mesh", ("10.0.0.1", 8700), both.now)


def answer(both: Pair) -> None:
    for datagram in both.leave(both.b):
        both.a.receive(datagram.data, "mesh", ("10.0.0.2", 8700), both.now)


def check(both: Pair, messages: int) -> None:
    """All arrived, and nothing was taken for lost, not even for a moment."""
    both.roundtrip(times=20)
    ended = [event for event in both.events(both.a) if isinstance(event, MessageDelivered)]
    assert len(ended) == messages
    sender = both.a._state.peer_table.peers["b"].open_sender()
    assert (sender.retransmitted, sender.in_flight.spurious) == (0, 0)


def test_a_batch_larger_than_the_bitmap_is_acknowledged_from_its_beginning() -> None:
    both = pair(*TOPICS, window=4096)
    receive(both, leave_large(both))
    answer(both)
    check(both, 1)


def test_packets_that_an_urgent_one_overtook_by_more_than_the_bitmap_are_acknowledged() -> None:
    both = pair(*TOPICS, window=4096, rates=Rates(ack_every_packets=32))
    bulk = leave_large(both)
    both.a.send("stop", b"stop", destination="b", now=both.now)
    receive(both, both.leave(both.a))
    answer(both)
    for start in range(0, len(bulk), 50):
        receive(both, bulk[start : start + 50])
        answer(both)
    check(both, 2)
