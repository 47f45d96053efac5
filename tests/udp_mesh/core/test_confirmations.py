"""A message of a topic with an outbox on disk is delivered once the receiving application has confirmed it."""

from __future__ import annotations

import random
from functools import partial

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageExpired, MessageReceived, Receipt
from udp_mesh.core.peer_lifecycle import set_offline, set_online
from udp_mesh.core.receiver import receiver
from udp_mesh.core.settings import Outbox, Topic

KEPT = Topic("kept", outbox=Outbox.ALL, outbox_on_disk=True)


def world(*, confirms: bool = True, topic: Topic = KEPT, loss: float = 0.0) -> World:
    made = World(seed=3)
    made.add(settings("a", topic))
    made.add(settings("b", confirms=confirms))
    for pipe in made.pipes.values():
        pipe.loss = loss
    made.run(5.0)
    return made


def receipts(made: World) -> list[Receipt]:
    found = [event.receipt for event in made.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    return [receipt for receipt in found if receipt is not None]


@pytest.mark.parametrize("size", [10, 50_000])
def test_a_message_counts_as_delivered_only_once_confirmed(size: int) -> None:
    made = world()
    made.send("a", "kept", bytes(size), destination="b")
    made.run(20.0)
    (receipt,) = receipts(made)
    assert made.events_of("a", MessageDelivered) == []
    made.nodes["b"].confirm(receipt)
    made.run(1.0)
    assert len(made.events_of("a", MessageDelivered)) == 1
    made.nodes["b"].confirm(receipt)
    made.run(5.0)
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_topics_and_peers_without_confirmations_deliver_on_acknowledgement() -> None:
    for made, topic in ((world(), "any"), (world(confirms=False), "kept")):
        made.send("a", topic, b"x", destination="b")
        made.run(2.0)
        assert receipts(made) == []
        assert len(made.events_of("a", MessageDelivered)) == 1


def test_a_lost_confirmation_is_repeated_and_nothing_arrives_twice() -> None:
    made = world(loss=0.3)
    rng = random.Random(5)
    for number in range(200):
        made.at(made.now + number * 0.05, partial(made.send, "a", "kept", b"%d" % number, "b"))

    def confirm() -> None:
        for receipt in receipts(made):
            if rng.random() < 0.5:
                made.nodes["b"].confirm(receipt)
        made.at(made.now + 0.2, confirm)

    confirm()
    made.run(120.0)
    assert len(made.events_of("b", MessageReceived)) == 200
    assert len(made.events_of("a", MessageDelivered)) == 200


def test_a_receiver_killed_before_confirming_gets_the_message_again() -> None:
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(1.0)
    made.add(settings("b", confirms=True))
    made.run(30.0)
    assert len(made.events_of("b", MessageReceived)) == 2
    assert made.events_of("a", MessageDelivered) == []
    made.nodes["b"].confirm(receipts(made)[1])
    made.run(1.0)
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_an_unconfirmed_message_survives_a_disconnect_and_arrives_once() -> None:
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(1.0)
    for pipe in made.pipes.values():
        pipe.up = False
    made.run(60.0)
    made.nodes["b"].confirm(receipts(made)[0])
    for pipe in made.pipes.values():
        pipe.up = True
    made.run(30.0)
    assert len(made.events_of("b", MessageReceived)) == 1
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_a_confirmation_right_after_a_peer_returns_is_accepted() -> None:
    """Before the maintenance round that would forget the withdrawn message."""
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(1.0)
    (receipt,) = receipts(made)
    node = made.nodes["a"]
    peer = node._state.peer_table.peers["b"]
    set_offline(node._state, peer, made.now, left=False)
    assert peer.session is not None
    set_online(node._state, peer, peer.session, made.now)
    made.nodes["b"].confirm(receipt)
    made.run(0.1)
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_a_message_the_receiver_could_not_store_is_resent_on_request() -> None:
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(1.0)
    made.nodes["b"].request_again(receipts(made)[0])
    made.run(5.0)
    assert len(receipts(made)) == 2
    made.nodes["b"].confirm(receipts(made)[1])
    made.run(1.0)
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_a_message_that_is_not_confirmed_in_its_lifetime_expires() -> None:
    made = world(topic=Topic("kept", outbox=Outbox.ALL, outbox_on_disk=True, deadline_s=3.0))
    made.send("a", "kept", b"x", destination="b")
    made.run(10.0)
    assert len(made.events_of("a", MessageExpired)) == 1
    made.nodes["b"].confirm(receipts(made)[0])
    made.run(5.0)
    assert made.events_of("a", MessageDelivered) == []
    sender = made.nodes["a"]._state.peer_table.peers["b"].sender
    assert sender is not None
    assert sender.unconfirmed == {}


def test_unconfirmed_messages_at_the_receiver_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(receiver, "MAX_UNCONFIRMED", 10)
    made = world()
    for _ in range(30):
        made.send("a", "kept", b"x", destination="b")
    made.run(20.0)
    assert len(made.events_of("b", MessageReceived)) == 10
    while len(made.events_of("a", MessageDelivered)) < 30:
        for receipt in receipts(made):
            made.nodes["b"].confirm(receipt)
        made.run(5.0)


def test_a_lost_request_to_send_again_is_repeated_and_not_taken_for_a_confirmation() -> None:
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(0.5)
    made.pipes["b", "a"].loss = 1.0
    made.nodes["b"].request_again(receipts(made)[0])
    made.run(0.1)
    made.pipes["b", "a"].loss = 0.0
    made.run(10.0)
    assert made.events_of("a", MessageDelivered) == []
    assert len(receipts(made)) == 2
    made.nodes["b"].confirm(receipts(made)[1])
    made.run(1.0)
    assert len(made.events_of("a", MessageDelivered)) == 1


def test_a_late_confirmation_to_an_earlier_run_of_the_sender_disturbs_nothing() -> None:
    """A packet number of the earlier run, kept account of as one of the current run, would shift the meaning of all
    acknowledgments that follow."""
    made = world()
    made.send("a", "kept", b"x", destination="b")
    made.run(1.0)
    (receipt,) = receipts(made)
    made.add(settings("a", KEPT))
    made.run(5.0)
    made.pipes["b", "a"].delay_s = 0.2
    made.send("b", "any", bytes(50_000), destination="a")
    made.run(0.05)
    made.nodes["b"].confirm(receipt)
    made.run(0.001)
    peer = made.nodes["b"]._state.peer_table.peers["a"]
    assert peer.session is not None
    assert peer.open_sender().in_flight.outstanding
    assert peer.open_sender().in_flight.next_number == peer.session.path.channel.next_number
