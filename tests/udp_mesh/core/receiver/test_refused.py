"""Fragments of messages that were refused, or forgotten while their program had them."""

from udp_mesh.core.receiver.memory_limit import MemoryBudget
from udp_mesh.core.receiver.receiver import Receiver
from udp_mesh.core.settings import Limits, Rates
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead, RefuseReason


def receiver() -> Receiver:
    return Receiver(Rates(), Limits(), MemoryBudget(1 << 20))


def test_plain_fragments_of_a_refused_message_are_not_acknowledged() -> None:
    own = receiver()
    head = MessageHead(10, 4, 1, 5, MessageFlag.RELIABLE, 0)
    assert own.receive_fragment(Fragment(7, 0, b"abc", head), 0.0, broadcast=False)
    assert not own.receive_fragment(Fragment(7, 4, b"x"), 0.0, broadcast=False)
    assert [refusal.reason for refusal in own.refusals] == [RefuseReason.CORRUPT]
    plain = Fragment(7, 1, b"d")
    assert not own.receive_plain(encode([plain]), 2, 0.0)
    assert not own.receive_fragment(plain, 0.0, broadcast=False)
    assert own.acks.largest < 0


def test_a_message_that_waits_for_its_program_is_not_requested_again_when_its_number_is_forgotten() -> None:
    own = receiver()
    for message_id in (5, 6):
        own.unicasts.forgotten.add(message_id)
    own.unconfirmed.add(5)
    assert own.receive_fragment(Fragment(5, 1, b"x"), 0.0, broadcast=False)
    assert own.refusals == []
    assert not own.receive_fragment(Fragment(6, 1, b"x"), 0.0, broadcast=False)
    assert [refusal.reason for refusal in own.refusals] == [RefuseReason.FORGOTTEN]
