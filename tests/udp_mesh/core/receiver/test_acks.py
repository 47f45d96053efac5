"""Which packets an acknowledgment reports, and when one is due."""

from udp_mesh.core.receiver.acks import AckState
from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.receiver.receiver import Receiver
from udp_mesh.core.settings import Limits, Rates
from udp_mesh.wire.limits import ACK_BITMAP_BITS


def test_the_bitmap_covers_exactly_its_bits() -> None:
    acks = AckState()
    acks.on_packet(0, 1.0)
    acks.on_packet(ACK_BITMAP_BITS, 2.0)
    assert (acks.received, acks.arrived_at) == (1 << ACK_BITMAP_BITS | 1, 2.0)
    late = AckState()
    late.on_packet(ACK_BITMAP_BITS, 1.0)
    late.on_packet(0, 2.0)
    assert (late.received, late.arrived_at, late.overtaken) == (1 << ACK_BITMAP_BITS | 1, 1.0, None)


def test_a_packet_below_the_bitmap_is_acknowledged_on_its_own() -> None:
    acks = AckState()
    acks.on_packet(2000, 1.0)
    for number in (700, 699, 700 - ACK_BITMAP_BITS):
        acks.on_packet(number, 2.0)
    overtaken = acks.overtaken
    assert overtaken is not None
    # The last one is below that bitmap too: it counts as lost.
    assert (overtaken.largest, overtaken.received, overtaken.pending) == (700, 0b11, 2)
    assert overtaken.overtaken is None


def test_a_gap_is_acknowledged_once_three_later_packets_arrived() -> None:
    receiver = Receiver(Rates(ack_every_packets=100), Limits(), MemoryBudget(1 << 20))
    acks = receiver.acks
    due = []
    for number in (0, 2, 3, 4, 5, 6):
        receiver.on_accepted(number, 0.0, ack_now=False)
        due.append(acks.send_now)
        if acks.send_now:
            acks.on_ack_sent()
    assert due == [False, False, False, True, False, False]


def test_the_first_packet_is_acknowledged_at_once_if_earlier_ones_are_missing() -> None:
    receiver = Receiver(Rates(), Limits(), MemoryBudget(1 << 20))
    receiver.on_accepted(1, 0.0, ack_now=False)
    assert receiver.acks.send_now
