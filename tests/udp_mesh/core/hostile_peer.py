"""A key holder that sends well-formed frames with any fields, to a node that sends to it and to another one meanwhile.

Unlike mutated bytes, most of what comes from here is decoded: numbers near those in use and at the ends of their
ranges, heads and fragments that contradict each other, acknowledgements and requests of what was never sent.
"""

from __future__ import annotations

import random
import struct
from collections.abc import Callable

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.broadcast import MAX_MISSING
from udp_mesh.core.events import MessageDelivered, MessageReceived
from udp_mesh.core.peers.path_validation import MAX_CHALLENGES
from udp_mesh.core.peers.session import MAX_PENDING_CONTROL
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.receiver.receiver import MAX_REFUSED_REMEMBERED, MAX_UNCONFIRMED
from udp_mesh.core.settings import Limits, Outbox, Rates, Topic
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import (
    Ack,
    Bye,
    Cancel,
    Delivered,
    Fragment,
    Frame,
    Heartbeat,
    MessageHead,
    Nack,
    Ping,
    Pong,
    Refused,
    RefuseReason,
    Sent,
    TopicAnnounce,
    Waiting,
)
from udp_mesh.wire.limits import ACK_BITMAP_BITS, HEARD_TAG_BYTES, MAX_IDS, MAX_RANGES, MAX_WAITING

TOPICS = (
    Topic("stop", priority=0),
    Topic("map", priority=9),
    Topic("news", priority=5, keep_last=2),
    Topic("kept", priority=6, outbox=Outbox.ALL),
    Topic("stored", priority=6, outbox=Outbox.ALL, outbox_on_disk=True),
    Topic("packed", priority=8, compression=True),
    Topic("grid", priority=7, delta=True),
    Topic("alert", priority=1, repair=True, reliable=False),
    Topic("view", priority=5, reliable=False),
)
MAX_PARTIAL_BYTES, MAX_PEERS, MAX_TOPICS = 500_000, 16, 64
LIMITS = Limits(
    partial_bytes=MAX_PARTIAL_BYTES, peers=MAX_PEERS, strangers=8, topics_per_peer=MAX_TOPICS, queue_bytes=4_000_000
)
RATES = Rates(offline_s=3.0, peer_lost_s=6.0)


class HostilePeer:
    """Nodes a (hostile), b and c. `receive` sends one datagram of a to b, `run` lets all of them go on."""

    def __init__(self, seed: int) -> None:
        self.rng = random.Random(seed)
        self.world = World(seed)
        for name in ("a", "b", "c"):
            self.world.add(settings(name, *TOPICS, limits=LIMITS, rates=RATES))
        self.world.run(3.0)
        self._exchange()
        self.world.run(1.0)

    def _exchange(self) -> None:
        for topic in TOPICS:
            size = self.rng.choice((1, 300, 3000, 20_000))
            for destination in ("a", "c", None):
                self.world.send("b", topic.name, bytes(size), destination)
            self.world.send("a", topic.name, bytes(size), "b")

    def receive(self) -> None:
        """One datagram with random frames, to b alone or to all."""
        a, b = self.world.nodes["a"]._state, self.world.nodes["b"]._state
        peer = a.peer_table.peers["b"]
        assert peer.session is not None
        draw = self.rng.random
        frames = [self._frame() for _ in range(self.rng.choice((1, 1, 1, 2, 3, 8, 40)))]
        # One without its sender's clock could be a recording, and is dropped.
        if draw() < 0.9:
            frames.insert(0, Sent(self._clock()))
        try:
            data = encode(frames, compact=draw() < 0.5)
        except (ValueError, OverflowError, struct.error):
            return
        if draw() < 0.3:
            channel = a.broadcast_channel
        else:
            channel = peer.session.path.channel
            # The sender keeps account of the numbers.
            peer.open_sender().in_flight.add(channel.next_number, None)
        sealed = (channel.seal if draw() < 0.8 else channel.seal_long)(data)[1]
        self.world.nodes["b"].receive(sealed, "mesh", self.world.addresses["a"], self.world.now)
        assert b.event_queue.counters.datagrams_received

    # Fields

    def _number(self, bits: int, *near: int) -> int:
        """Near one of these, or at an end of the range."""
        middle = self.rng.choice((*near, *near, 0, 1, 1 << (bits - 1), (1 << bits) - 1, self.rng.getrandbits(bits)))
        return min((1 << bits) - 1, max(0, middle + self.rng.choice((0, 0, 0, 1, 2, -1, -2, 7, -7, 300, -300))))

    def _clock(self) -> int:
        """Rarely a wrong one: after that what has a right one is taken for late, and dropped."""
        return self.rng.getrandbits(32) if self.rng.random() < 0.0005 else clock_ms(self.world.now)

    def _message_id(self) -> int:
        """One that a or b used lately."""
        a, b = self.world.nodes["a"]._state, self.world.nodes["b"]._state
        near = [state.broadcasts.next_number for state in (a, b)]
        for state, name in ((a, "b"), (b, "a")):
            near.append(state.peer_table.peers[name].open_sender().next_wire_id)
        return self._number(32, *near)

    def _waiting(self) -> tuple[Waiting, ...]:
        count = self.rng.choice((0, 0, 1, MAX_WAITING))
        return tuple(Waiting(self.rng.randrange(16), self._number(16)) for _ in range(count))

    def _ids(self) -> tuple[int, ...]:
        return tuple(self._message_id() for _ in range(self.rng.choice((1, 1, 3, MAX_IDS))))

    def _frame(self) -> Frame:
        makers: tuple[Callable[[], Frame], ...] = (
            *(self._fragment,) * 5,
            *(self._ack,) * 4,
            lambda: Delivered(self._ids(), self.rng.random() < 0.2),
            lambda: Cancel(self._ids(), self.rng.random() < 0.3),
            lambda: Refused(self._message_id(), self.rng.choice(list(RefuseReason)), self.rng.random() < 0.3),
            self._nack,
            self._announce,
            lambda: Ping(self._number(64)),
            self._pong,
            self._heartbeat,
            lambda: Sent(self._clock()),
            *(lambda: Bye("so long"),) * (self.rng.random() < 0.02),
        )
        return self.rng.choice(makers)()

    def _fragment(self) -> Frame:
        rng = self.rng
        payload = bytes(rng.choice((0, 1, 100, 1200)))
        broadcast_id = rng.random() < 0.2
        position = rng.choice((0, 0, 1, 2, self._number(24)))
        head = None
        if position == 0:
            head = MessageHead(
                self._number(30, len(payload), 3 * len(payload)),
                self._number(21, 1, 2, 3),
                rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 8, 9, self._number(16))),
                rng.randrange(16),
                rng.choice((0, 1, rng.getrandbits(8))),
                self._number(32),
                rng.choice((None, self._number(32))),
            )
        return Fragment(self._message_id(), position, payload, head, rng.random() < 0.5, broadcast_id)

    def _ack(self) -> Frame:
        session = self.world.nodes["b"]._state.peer_table.peers["a"].session
        assert session is not None
        bitmap = self.rng.choice((0, (1 << ACK_BITMAP_BITS) - 1, self.rng.getrandbits(ACK_BITMAP_BITS)))
        largest = self._number(48, session.path.channel.next_number, session.path.channel.next_number - 1)
        bitmap &= (1 << min(largest, ACK_BITMAP_BITS)) - 1
        return Ack(largest, bitmap, self._number(24), self._number(32), self._waiting())

    def _nack(self) -> Frame:
        count = self.rng.choice((0, 1, MAX_RANGES))
        return Nack(self._message_id(), tuple((self._number(20), 1 + self._number(10)) for _ in range(count)))

    def _announce(self) -> Frame:
        name = self.rng.choice([topic.name for topic in TOPICS] + ["~log/x", "~mesh/conditions", "x" * 255, "é"])
        if self.rng.random() < 0.5:
            name = f"{name[:240]}{self.rng.getrandbits(10)}"
        return TopicAnnounce(self._number(16, 3, 5), name, self.rng.choice(("", "std_msgs/String", "t" * 255)))

    def _pong(self) -> Frame:
        session = self.world.nodes["b"]._state.peer_table.peers["a"].session
        assert session is not None
        return Pong(self.rng.choice((*session.challenges, self._number(64))), self._number(32))

    def _heartbeat(self) -> Frame:
        rng = self.rng
        nodes = self.world.nodes
        boots = [nodes[name]._state.boot_id[:HEARD_TAG_BYTES] for name in nodes]
        heard = tuple(rng.sample(boots, rng.randrange(len(boots) + 1)))
        clocks = tuple(rng.getrandbits(24) for _ in range(rng.randrange(len(heard) + 1)))
        clock = rng.choice((self._clock(), None))
        low = rng.choice((1, 1, 1, 2, 7))
        name = rng.choice(("a", "a", "b", "c", f"n{rng.getrandbits(8)}"))
        state = nodes["a"]._state
        return Heartbeat(
            name,
            low,
            rng.choice((low, 7)),
            rng.choice((rng.getrandbits(32), (1 << 11) - 1)),
            self._number(16) or 1,
            self._number(16),
            self._number(32),
            self._number(64, state.broadcast_channel.next_number),
            self._number(32, state.broadcasts.next_number),
            heard,
            self._waiting(),
            clock,
            clocks if clock is not None else (),
        )

    # What holds

    def run(self, seconds: float) -> None:
        if self.rng.random() < 0.1:
            self._exchange()
        self.world.run(seconds)
        for found in self.world.events.values():
            found.clear()

    def check_bounds(self) -> None:
        """Raises AssertionError if b holds more than its limits allow."""
        state = self.world.nodes["b"]._state
        table = state.peer_table
        assert len(table.peers) <= MAX_PEERS
        assert table.memory.bytes <= MAX_PARTIAL_BYTES
        assert table.send_memory.bytes <= LIMITS.queue_bytes * 5 // 4
        assert all(len(repairs._missing) <= MAX_MISSING for repairs in state.repairs.values())
        for session in table.sessions.values():
            receiver = session.receiver
            assert len(receiver.topics) <= MAX_TOPICS
            assert len(receiver.unconfirmed) <= MAX_UNCONFIRMED
            assert len(receiver._refused) <= MAX_REFUSED_REMEMBERED
            assert len(session.challenges) <= MAX_CHALLENGES
            assert len(session.pending_control) <= MAX_PENDING_CONTROL

    def works(self) -> bool:
        """Whether b and c still exchange messages, and b and the next run of a do."""
        self.world.add(settings("a", *TOPICS, limits=LIMITS, rates=RATES))
        self.world.run(30.0)
        for found in self.world.events.values():
            found.clear()
        pairs = [("b", "c"), ("c", "b"), ("a", "b"), ("b", "a")]
        for source, destination in pairs:
            self.world.send(source, "stop", b"still here", destination)
        self.world.run(30.0)
        events = [(name, event) for name in self.world.nodes for _, event in self.world.events[name]]
        delivered = {(name, event.peer) for name, event in events if isinstance(event, MessageDelivered)}
        received = {
            (event.source, name)
            for name, event in events
            if isinstance(event, MessageReceived) and event.payload == b"still here"
        }
        return set(pairs) <= delivered & received
