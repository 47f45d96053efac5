"""One bound for all peers: a key holder invents names freely, but not memory."""

from __future__ import annotations

import random

from tests.udp_mesh.core.pair import KEY, Pair, pair
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.receiver.memory_limit import MIN_RANGES_PER_PEER, Account, MemoryBudget
from udp_mesh.core.settings import Limits
from udp_mesh.crypto import SendChannel
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, Heartbeat, MessageHead, TopicAnnounce
from udp_mesh.wire.limits import HEARD_TAG_BYTES

TOTAL = 1_000_000
FORGER = ("10.0.0.66", 8700)


class Insider:
    """A key holder with as many names as it likes."""

    def __init__(self, both: Pair, names: int) -> None:
        self.both = both
        rng = random.Random(3)
        self.channels = []
        own = both.b._state.boot_id
        for number in range(names):
            channel = SendChannel(KEY, rng.randbytes(16), own)
            beat = Heartbeat(f"ghost{number}", 1, 1, 0, 1000, 0, 0, 0, 0, (own[:HEARD_TAG_BYTES],))
            both.b.receive(channel.seal_long(encode([beat]))[1], "mesh", FORGER, both.now)
            self.channels.append(channel)

    def say(self, channel: SendChannel, *frames: Fragment | TopicAnnounce) -> None:
        self.both.b.receive(channel.seal(encode(frames))[1], "mesh", FORGER, self.both.now)


def test_many_peer_names_share_one_memory_limit_and_leave_room_for_a_peer() -> None:
    both = pair(limits=Limits(partial_bytes=TOTAL))
    insider = Insider(both, 8)
    for number in range(300):
        for channel in insider.channels:
            insider.say(channel, Fragment(number % 40, 1 + number, bytes(1300)))
    held = both.b.conditions(both.now).partial_bytes
    assert TOTAL // 3 < held <= TOTAL
    assert both.b._state.peer_table.memory.bytes <= TOTAL
    for node, other in ((both.a, "b"), (both.b, "a")):
        node.send("any", bytes(30_000), destination=other, now=both.now)
    both.roundtrip(times=60)
    assert any(isinstance(event, MessageReceived) for event in both.events(both.b))


def test_topic_names_and_tiny_messages_count_toward_the_memory_limit() -> None:
    both = pair(limits=Limits(partial_bytes=TOTAL))
    insider = Insider(both, 8)
    for number in range(1000):
        for channel in insider.channels:
            insider.say(
                channel,
                TopicAnnounce(number, "t" * 250 + str(number)),
                Fragment(number, 0, b"x", MessageHead(9, 5, 1, 0, 1)),
            )
    memory = both.b._state.peer_table.memory
    assert TOTAL // 3 < memory.bytes <= TOTAL
    kept = sum(len(session.receiver.topics) for session in both.b._state.peer_table.sessions.values())
    assert kept < 8 * 1000


def test_memory_of_a_forgotten_peer_is_released() -> None:
    both = pair(limits=Limits(partial_bytes=TOTAL))
    insider = Insider(both, 4)
    for number in range(200):
        for channel in insider.channels:
            insider.say(channel, Fragment(number % 40, 1 + number, bytes(1300)))
    peer_table = both.b._state.peer_table
    for session in list(peer_table.sessions.values()):
        if session.name.startswith("ghost"):
            peer_table.forget(session)
    assert peer_table.memory.bytes < 10_000
    assert peer_table.memory.holders <= 1


def test_completed_messages_release_their_fragment_memory() -> None:
    both = pair()
    for _ in range(5):
        both.a.send("any", bytes(300_000), destination="b", now=both.now)
        both.roundtrip(times=200, step_s=0.005)
    assert len([event for event in both.events(both.b) if isinstance(event, MessageReceived)]) == 5
    assert both.b._state.peer_table.memory.bytes < 2000


def test_peers_get_equal_shares_above_half_the_budget_and_nothing_above_the_limit() -> None:
    memory = MemoryBudget(1000)
    greedy, late = Account(memory), Account(memory)
    while greedy.has_room(10):
        greedy.reserve(10)
    assert greedy.bytes == 500
    late.reserve(10)
    while late.has_room(10):
        late.reserve(10)
    assert late.bytes == 250
    assert not greedy.has_room(1)
    channel_share = [Account(memory) for _ in range(100)]
    for one in channel_share:
        while one.has_room(1):
            one.reserve(1)
    assert memory.bytes <= 1000
    late.count_ranges(1 << 20)
    assert late.too_many_ranges(MIN_RANGES_PER_PEER + 1)
    assert not late.too_many_ranges(MIN_RANGES_PER_PEER)
