"""A fragment that was lost before a silence of its sender, and replayed after it: it has no timestamp, and its number
never arrived."""

from __future__ import annotations

import pytest

from tests.udp_mesh.core.pair import Pair, pair
from udp_mesh.core.events import ExpiryReason, MessageReceived
from udp_mesh.core.interfaces import Datagram
from udp_mesh.wire.header import DATA_BYTE

A = ("10.0.0.1", 8700)


def recorded_before_a_silence() -> tuple[Pair, list[Datagram]]:
    """Fragments from the middle of a message, which b did not hear, and nothing else for 15 s."""
    both = pair()
    for node, other in ((both.a, "b"), (both.b, "a")):
        node.send("any", b"hello", destination=other, now=both.now)
    both.roundtrip(times=30)
    both.a.send("any", bytes(20_000), destination="b", now=both.now)
    _, *middle = [datagram for datagram in both.drop(both.a) if datagram.data[0] == DATA_BYTE]
    both.a._state.peer_table.peers["b"].open_sender().finish_all(ExpiryReason.DEADLINE)
    for _ in range(15):
        both.drop(both.a)
        both.drop(both.b)
        both.now += 1.0
    return both, middle


def accepted(both: Pair, datagrams: list[Datagram]) -> int:
    """How many of these are accepted by b."""
    before = both.b.conditions(both.now).counters
    for datagram in datagrams:
        both.b.receive(datagram.data, "mesh", A, both.now)
    after = both.b.conditions(both.now).counters
    stale, replayed = after.dropped_stale - before.dropped_stale, after.dropped_replayed - before.dropped_replayed
    return len(datagrams) - stale - replayed


@pytest.mark.parametrize("step_s", [0.02, 1.0])
def test_what_was_recorded_before_the_silence_is_rejected_after_it(step_s: float) -> None:
    both, middle = recorded_before_a_silence()
    assert len(middle) > 3
    # at first a is heard by its heartbeats, and then by messages
    for _ in range(100):
        both.roundtrip(times=1, step_s=step_s)
        assert accepted(both, middle[:1]) == 0
    both.a.send("any", b"again", destination="b", now=both.now)
    both.roundtrip(times=10)
    assert accepted(both, middle) == 0


def test_messages_of_any_size_arrive_after_the_silence() -> None:
    both, _ = recorded_before_a_silence()
    both.roundtrip(times=30, step_s=0.1)
    both.events(both.b)
    both.a.send("any", bytes(20_000), destination="b", now=both.now)
    both.roundtrip(times=60)
    assert [len(event.payload) for event in both.events(both.b) if isinstance(event, MessageReceived)] == [20_000]
