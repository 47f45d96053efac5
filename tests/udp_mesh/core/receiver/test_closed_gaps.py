"""Numbers in a gap that was closed to save memory: nothing that has not arrived is taken for finished."""

from __future__ import annotations

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.receiver.reassembly import CompleteMessage, FragmentStatus, Reassembly
from udp_mesh.core.settings import Limits, Topic
from udp_mesh.wire.frames import Fragment, MessageHead


def whole(number: int) -> Fragment:
    return Fragment(number, 0, b"x", MessageHead(1, 1, 1, 3, 0))


def test_a_message_that_falls_into_a_closed_gap_is_asked_for_again() -> None:
    """A reliable message that waits while thousands of best-effort messages after it are lost."""
    reassembly = Reassembly(Limits(finished_ranges_per_peer=4))
    for number in range(10, 40, 2):
        assert isinstance(reassembly.add(whole(number), 100.0), CompleteMessage)
    assert reassembly.add(whole(11), 100.0) is FragmentStatus.FORGOTTEN
    assert reassembly.add(whole(38), 100.0) is FragmentStatus.DUPLICATE
    assert isinstance(reassembly.add(whole(37), 100.0), CompleteMessage)


def test_broadcasts_with_repair_arrive_however_many_of_the_others_are_lost() -> None:
    both = pair(Topic("pose", reliable=False), Topic("news", repair=True), limits=Limits(finished_ranges_per_peer=4))
    both.a.send("news", b"first", now=both.now)
    both.roundtrip(3)
    for number in range(40):
        both.a.send("pose", b"%d" % number, now=both.now)
        if number % 2:
            both.drop(both.a)
        both.roundtrip(1)
    both.a.send("news", b"last", now=both.now)
    both.roundtrip(60)
    news = [
        event.payload for event in both.events(both.b) if isinstance(event, MessageReceived) and event.topic == "news"
    ]
    assert news == [b"first", b"last"]
