"""Packets in flight are recorded under the numbers that their datagrams have."""

from __future__ import annotations

from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.sent_packets import (
    REMEMBERED_NUMBERS,
    REORDER_PACKETS,
    Packet,
    SendSnapshot,
    SentPackets,
)
from udp_mesh.core.settings import Topic

SNAPSHOT = SendSnapshot(0.0, 0, 0.0, 0.0, app_limited=False)


def message(fragments: int) -> OutgoingMessage:
    topic = Topic("t")
    accepted = AcceptedMessage(MessageId(1), TopicChannel(0, topic, "t", ""), b"x", b"x", 0, 0.0, None)
    outgoing = OutgoingMessage(accepted, 8, reliable=True)
    outgoing.fragments = fragments
    return outgoing


def test_a_channel_that_was_used_before_it_had_a_sender_continues_its_numbers() -> None:
    """Challenges to a node that is not verified yet are numbered too."""
    sent = SentPackets()
    sent.add(2, Packet(SNAPSHOT, message(1), 0))
    assert sent.next_number == 3
    acknowledged, lost, _ = sent.acknowledge(2, 1)
    assert (len(acknowledged), lost) == (1, [])


def test_a_run_continues_the_numbers_as_well() -> None:
    sent = SentPackets()
    sent.add_run(5, SNAPSHOT, message(3), range(3))
    assert (sent.base, sent.next_number) == (5, 8)
    acknowledged, lost, _ = sent.acknowledge(6, 0b11)
    assert ([packet.position for packet in acknowledged], lost) == ([0, 1], [])


def in_flight(count: int, *, urgent: bool = False) -> SentPackets:
    """Packets 0 to count - 1, none of them acknowledged."""
    sent = SentPackets()
    for number in range(count):
        sent.add(number, Packet(SNAPSHOT._replace(urgent=urgent), message(1), 0))
    return sent


def test_a_packet_called_lost_that_arrives_raises_the_reordering_threshold() -> None:
    sent = in_flight(4)
    _, lost, _ = sent.acknowledge(3, 0b0111)
    assert (len(lost), sent.reorder_packets) == (1, REORDER_PACKETS)
    acknowledged, _, late = sent.acknowledge(3, 0b1111)
    assert (len(acknowledged), late, sent.spurious) == (1, None, 1)
    assert sent.reorder_packets == REORDER_PACKETS + 1


def test_an_acknowledgment_beyond_what_was_sent_revives_no_lost_packet() -> None:
    sent = in_flight(4)
    sent.acknowledge(3, 0b0111)
    acknowledged, lost, newest = sent.acknowledge(4, 0b11111)
    assert (acknowledged, lost, newest) == ([], [], None)


def test_a_restart_forgets_what_was_lost_and_what_arrived() -> None:
    """The numbers of the peer's earlier boot mean other packets now."""
    sent = in_flight(10)
    sent.acknowledge(9, 0b01_1111_1111)
    sent.restart(0)
    for number in range(3):
        sent.add(number, Packet(SNAPSHOT, message(1), 0))
    acknowledged, lost, _ = sent.acknowledge(2, 0b101)
    assert (len(acknowledged), lost) == (2, [])


def test_three_later_packets_prove_that_a_timed_out_one_is_lost() -> None:
    sent = in_flight(6, urgent=True)
    assert len(sent.declare_lost_before(0.0)) == 6
    assert sent.confirm_timed_out(2, 0b011) == 0
    assert sent.confirm_timed_out(3, 0b0111) == 1


def test_an_outage_proves_no_loss() -> None:
    sent = in_flight(2, urgent=True)
    sent.declare_lost_before(0.0)
    sent.add(2, Packet(SNAPSHOT, message(1), 0))
    sent.abandon_all()
    assert sent.confirm_timed_out(9, 0) == 0


def test_what_a_radios_queue_kept_during_an_outage_is_acknowledged_after_it() -> None:
    """The queue keeps the first packets of an outage, and many more were sent behind them."""
    sent = in_flight(1000)
    sent.declare_lost_before(0.0)
    acknowledged, _, late = sent.acknowledge(9, (1 << 10) - 1)
    assert (len(acknowledged), late is not None) == (10, True)
    acknowledged, _, _ = sent.acknowledge(20, 0b101)
    assert len(acknowledged) == 2


def test_lost_packets_are_forgotten_when_no_acknowledgment_can_come_anymore() -> None:
    sent = in_flight(3 * REMEMBERED_NUMBERS)
    sent.declare_lost_before(0.0)
    assert sent.acknowledge(9, 1) == ([], [], None)
    assert len(sent.acknowledge(3 * REMEMBERED_NUMBERS - 1, 1)[0]) == 1


def test_an_urgent_packet_that_overtakes_a_whole_run_of_others_shows_no_loss() -> None:
    sent = in_flight(5)
    sent.add(5, Packet(SNAPSHOT._replace(urgent=True), message(1), 0))
    acknowledged, lost, _ = sent.acknowledge(5, 1)
    assert (len(acknowledged), lost) == (1, [])
    assert sent.outstanding == 5


def test_copies_in_flight_are_counted_until_they_are_decided() -> None:
    copy = SNAPSHOT._replace(urgent=True, copy=True)
    sent = SentPackets()
    for number in range(8):
        sent.add(number, Packet(copy if number % 2 else SNAPSHOT, message(1), 0))
    assert (sent.outstanding, sent.copies) == (8, 4)
    # 0 and 1 arrived, 2 and 3 were lost, 7 arrived.
    sent.acknowledge(1, 0b11)
    assert (sent.outstanding, sent.copies) == (6, 3)
    sent.acknowledge(7, 0b1)
    assert sent.copies == sum(packet is not None and packet.snapshot.copy for packet in sent._packets)
    sent.declare_lost_before(1.0)
    assert (sent.outstanding, sent.copies) == (0, 0)
    sent.add(8, Packet(copy, message(1), 0))
    sent.abandon_all()
    assert (sent.outstanding, sent.copies) == (0, 0)
