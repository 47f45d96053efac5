"""A message that its sender has cancelled is finished: fragments of it that arrive later deliver nothing."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Cancel, Fragment, Frame, MessageHead, Sent, TopicAnnounce


@pytest.mark.parametrize("cancelled", [True, False])
def test_fragments_of_a_cancelled_message_deliver_nothing(*, cancelled: bool) -> None:
    both = pair()
    both.a.send("any", b"first", destination="b", now=both.now)
    both.roundtrip(times=10)
    both.events(both.b)
    session = both.a._state.peer_table.peers["b"].session
    assert session is not None
    message: list[Frame] = [TopicAnnounce(9, "any", ""), Fragment(77, 0, b"x", MessageHead(1, 1, 9, 5, 1, 0))]
    for frames in ([Cancel((77 if cancelled else 78,))], message):
        _, data = session.path.channel.seal(encode([Sent(clock_ms(both.now)), *frames]))
        both.b.receive(data, "mesh", ("10.0.0.1", 8700), both.now)
    received = [event.payload for event in both.events(both.b) if isinstance(event, MessageReceived)]
    assert received == ([] if cancelled else [b"x"])
