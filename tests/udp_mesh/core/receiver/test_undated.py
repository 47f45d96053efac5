"""No message of a peer with timestamps begins in a datagram without one: it could be a recording of any age."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import pair
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, Frame, MessageHead, Sent, TopicAnnounce


@pytest.mark.parametrize("dated", [True, False])
def test_a_message_begins_only_in_a_datagram_with_a_timestamp(*, dated: bool) -> None:
    both = pair()
    both.a.send("any", b"first", destination="b", now=both.now)
    both.roundtrip(times=10)
    both.events(both.b)
    session = both.a._state.peer_table.peers["b"].session
    assert session is not None
    assert session.path.confirmed
    frames: list[Frame] = [TopicAnnounce(9, "any", ""), Fragment(77, 0, b"x", MessageHead(1, 1, 9, 5, 1, 0))]
    _, data = session.path.channel.seal(encode([Sent(clock_ms(both.now)), *frames] if dated else frames))
    both.b.receive(data, "mesh", ("10.0.0.1", 8700), both.now)
    received = [event.payload for event in both.events(both.b) if isinstance(event, MessageReceived)]
    assert received == ([b"x"] if dated else [])
