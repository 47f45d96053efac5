"""Running nodes for the fuzzer: a relay, whose neighbor is a key holder, two nodes with a shared log, two that send
selectively and keep versions, and a serial line."""

from __future__ import annotations

import random

from tests.udp_mesh.core.logs.team import LogTeam
from tests.udp_mesh.core.relaying.topologies import chain, online, reported
from tests.udp_mesh.core.subscriptions.team import TOPICS, config, met, read, received
from tests.udp_mesh.wire.log_vectors import CONTROL
from tests.udp_mesh.wire.make_vectors import REFUSED_VERSIONS, RELAY_FRAMES, VERSIONS, encode_relay
from tests.udp_mesh.wire.subscription_vectors import SUBSCRIPTIONS
from udp_mesh.core.events import MessageDelivered, MessageReceived, Rejected
from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, encode_item
from udp_mesh.core.logs.messages import Have, HaveEntry, Holder, ItemRequest, encode_control
from udp_mesh.core.logs.serving import MAX_QUEUED
from udp_mesh.core.receiver.datagram_age import clock_ms
from udp_mesh.core.relaying.hop_queue import MAX_HOP_BYTES
from udp_mesh.core.relaying.relaying import MAX_NEIGHBORS
from udp_mesh.core.settings import Topic
from udp_mesh.core.subscriptions.messages import ASK_TOPIC, TABLE_TOPIC, encode_ask, encode_table
from udp_mesh.core.versions.encoding import Version
from udp_mesh.core.versions.encoding import encode as encode_grid
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.wire.codec import encode
from udp_mesh.wire.frames import Fragment, MessageFlag, MessageHead, Sent, TopicAnnounce
from udp_mesh.wire.limits import MAX_THIN_FRAME_BYTES
from udp_mesh.wire.relay import Carry, encode_carry
from udp_mesh.wire.serial_framing import LineDecoder, encode_line
from udp_mesh.wire.version import version_hash
from udp_mesh.wire.xbee import _ESCAPED, RECEIVE_PACKET, START, XBeeDecoder

LOG_TOPIC = "artifact"
MAX_API_LINE_BYTES = 2 * (3 + 18 + 256)
"""An unfinished API frame of an XBee, each of its bytes escaped."""
MAX_COBS_LINE_BYTES = 255 + 6
GRID = Topic("grid", delta=True, always=True)
XBEE_ADDRESSES = bytes.fromhex("0013A20040A1B2C3 FFFE 02")
"""The sender's addresses and the options of a Receive Packet."""


class FuzzedRelay:
    """n1 - n2 - n3: frames of n1, a key holder, reach n2, which relays."""

    def __init__(self, seed: int) -> None:
        self.topology = chain(3, seed=seed)
        assert self.topology.run(60, lambda: online(self.topology, "n1", "n3") and online(self.topology, "n3", "n1"))
        names = ("n1", "n2", "n3")
        one, two, three = (self.topology.nodes[name]._state.boot_id for name in names)
        self.seeds = [encode_relay(frame) for frame in RELAY_FRAMES.values()]
        for priority, data in ((0, b""), (9, b"x" * 40)):
            self.seeds.append(encode_carry(Carry(priority, 4, one[:8], three[:8], (), data)))
        self._channels = self.topology.nodes["n1"]._relaying._channels
        self._hop = self._channels.add(two)
        self._source = next(link.address for link in self.topology.nodes["n2"]._relaying.neighbors[one].links.values())

    def receive(self, frame: bytes, *, to_all: bool) -> None:
        """A frame sealed by n1, at n2."""
        data = self._channels.seal_hello(frame) if to_all else self._channels.seal(self._hop, frame)[1]
        self.topology.nodes["n2"].receive(data, "n1", self._source, self.topology.now)

    def run(self, seconds: float) -> None:
        self.topology.run(seconds)

    def check_bounds(self) -> None:
        """Raises AssertionError if the relay holds more than its limits allow, or does not relay any more."""
        relaying = self.topology.nodes["n2"]._relaying
        assert len(relaying.neighbors) <= MAX_NEIGHBORS
        assert relaying.forwarding.budget.memory_bytes <= MAX_NEIGHBORS * MAX_HOP_BYTES

    def works(self) -> bool:
        """Whether a message still goes from one end to the other."""
        before = len(reported(self.topology, "n1", MessageDelivered))
        sent = self.topology.send("n1", "any", b"still here", destination="n3")
        assert not isinstance(sent, Rejected), sent
        return self.topology.run(60, lambda: len(reported(self.topology, "n1", MessageDelivered)) > before)


class FuzzedLogs:
    """Messages about shared logs from spot, a key holder, at base, which reads them."""

    def __init__(self, seed: int) -> None:
        self.team = LogTeam("base", "spot", seed=seed)
        self.team.connect("base", "spot")
        for number in range(3):
            self.team.publish("spot", b"artifact %d" % number)
        assert self.team.run(30, lambda: len(self.team.read("base")) == 3)
        logs = self.team.nodes["base"]._logs
        assert logs is not None
        self.replicator = logs.replicator
        real = next(key for key in self.replicator.holdings.logs if key.source == "spot")
        key = SigningKey(bytes(32))
        made = LogKey(LOG_TOPIC, "spot", key.public)
        control = [
            *CONTROL.values(),
            Have((HaveEntry(real, ((1, 9),), (Holder("base", ((1, 2),)),)), HaveEntry(made, ((1, 1 << 40),))), order=9),
            ItemRequest(((real, ((1, 3), (5, 1 << 40))),)),
        ]
        self.control = [encode_control(message) for message in control]
        self.items = [
            encode_item(key, LogItem(ItemId(made, number), 0, "", b"rope")) for number in (1, 2, 1 << 20, 1 << 40)
        ]

    def receive_control(self, data: bytes) -> None:
        self.replicator.on_control("spot", data, self.team.now)

    def receive_item(self, data: bytes) -> None:
        self.replicator.on_item("spot", LOG_TOPIC, data, self.team.now)

    def run(self, seconds: float) -> None:
        self.team.run(seconds)

    def check_bounds(self) -> None:
        """Raises AssertionError if the node holds more than its limits allow."""
        assert all(len(service.queue) <= MAX_QUEUED for service in self.replicator._serving._peers.values())

    def works(self) -> bool:
        """Whether a new item still arrives after the next meeting: until then the base believes what spot said."""
        self.team.publish("spot", b"still here")
        self.team.separate()
        self.team.run(20)
        self.team.connect("base", "spot")
        return self.team.run(60, lambda: any(payload == b"still here" for _, _, payload in self.team.read("base")))


class FuzzedMessages:
    """Whole messages of b, a key holder, at a: what its programs read, and versions."""

    def __init__(self, seed: int) -> None:
        self.world = met(config("a", *TOPICS, GRID), config("b", *TOPICS, GRID), seed=seed)
        read(self.world, "a", "grid", "map")
        peer = self.world.nodes["b"]._state.peer_table.peers["a"]
        assert peer.session is not None
        self._channel, self._in_flight = peer.session.path.channel, peer.open_sender().in_flight
        self._message_id = 1 << 16
        self.tables = [encode_ask() if table is None else encode_table(table) for table in SUBSCRIPTIONS.values()]
        grids = [bytes(random.Random(seed).randbytes(200)) + b"%d" % number for number in range(4)]
        bases = [None, *(Version(version_hash(grid), grid) for grid in grids)]
        sent = [encode_grid(grid, base, compression=True) for grid in grids for base in bases]
        self.versions = [(one.body, one.flags) for one in sent]
        self.versions += [(vector.body, vector.flags) for vector in VERSIONS.values()]
        self.versions += [(vector.body, vector.flags) for vector, _ in REFUSED_VERSIONS.values()]
        self._hashes: set[bytes] = set()

    def receive_table(self, body: bytes) -> None:
        self._receive(TABLE_TOPIC if body[:1] != encode_ask() else ASK_TOPIC, body, MessageFlag.RELIABLE)

    def receive_version(self, body: bytes, flags: int) -> None:
        self._hashes.add(body[4:12])
        self._receive("grid", body, flags | MessageFlag.VERSION | MessageFlag.RELIABLE)

    def _receive(self, topic: str, body: bytes, flags: int) -> None:
        self._message_id += 1
        topic_id = 0x8000 + len(topic)
        head = MessageHead(len(body), 1, topic_id, 4, flags)
        # One without its sender's clock could be a recording, and is dropped.
        sent = Sent(clock_ms(self.world.now))
        frames = encode([sent, TopicAnnounce(topic_id, topic, ""), Fragment(self._message_id, 0, body, head)])
        number, data = self._channel.seal(frames)
        self._in_flight.add(number, None)
        self.world.nodes["a"].receive(data, "mesh", self.world.addresses["b"], self.world.now)

    def run(self, seconds: float) -> None:
        """What a sends is compared with the table that b has by now."""
        for topic in ("map", "status", "grid"):
            self.world.send("a", topic, b"what b may read", "b")
        self.world.run(seconds)
        for name in self.world.nodes:
            for _, event in self.world.events[name]:
                if name == "a" and isinstance(event, MessageReceived) and event.topic == "grid":
                    assert version_hash(event.payload) in self._hashes
            self.world.events[name].clear()

    def check_bounds(self) -> None:
        """Raises AssertionError if the node holds more than its limits allow."""
        node = self.world.nodes["a"]
        limits = node._state.settings.limits
        session = node._state.peer_table.peers["b"].session
        assert session is not None
        assert session.receiver.versions.held.held_bytes <= limits.version_bytes_per_peer
        assert session.receiver.inflating_bytes <= limits.partial_bytes_per_peer

    def works(self) -> bool:
        """Whether b's next run gets what it reads, and its versions arrive: a table harms its sender until then."""
        self.world.add(config("b", *TOPICS, GRID))
        read(self.world, "b", "map")
        self.world.run(10.0)
        for number in range(2):
            self.world.send("a", "map", b"still here", "b")
            self.world.send("b", "grid", b"still here" * 10 + b"%d" % number, "a")
            self.world.run(2.0)
        maps, versions = received(self.world, "b", "map"), received(self.world, "a", "grid")
        return maps[-2:] == [b"still here"] * 2 and versions[-2:] == [b"still here" * 10 + b"%d" % i for i in range(2)]


class FuzzedLine:
    """Bytes of a serial line in one of three framings, at a decoder that continues from what came before."""

    def __init__(self) -> None:
        self._decoders = (LineDecoder(), XBeeDecoder(escaped=False), XBeeDecoder(escaped=True))

    def encode(self, framing: int, frame: bytes) -> bytes:
        """The bytes that bring a frame."""
        if framing == 0:
            return encode_line(frame)
        content = bytes((RECEIVE_PACKET,)) + XBEE_ADDRESSES + frame
        rest = len(content).to_bytes(2, "big") + content + bytes((0xFF - (sum(content) & 0xFF),))
        return START + (_ESCAPED.sub(lambda found: bytes((0x7D, found[0][0] ^ 0x20)), rest) if framing == 2 else rest)

    def feed(self, framing: int, data: bytes) -> list[bytes]:
        """The frames in these bytes."""
        decoder = self._decoders[framing]
        frames = decoder.feed(data)
        assert all(0 < len(frame) <= MAX_THIN_FRAME_BYTES for frame in frames)
        assert len(decoder._unfinished) <= (MAX_API_LINE_BYTES if framing else MAX_COBS_LINE_BYTES)
        return frames
