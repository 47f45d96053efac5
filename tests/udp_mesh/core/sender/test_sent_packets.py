"""Packets in flight are recorded under the numbers that their datagrams have."""

from __future__ import annotations

from udp_mesh.core.events import MessageId
from udp_mesh.core.sender.message import AcceptedMessage, OutgoingMessage, TopicChannel
from udp_mesh.core.sender.sent_packets import Packet, SendSnapshot, SentPackets
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
