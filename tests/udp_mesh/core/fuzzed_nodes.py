"""Running nodes for the fuzzer: a relay, whose neighbor is a key holder, and two nodes with a shared log."""

from __future__ import annotations

from tests.udp_mesh.core.logs.team import LogTeam
from tests.udp_mesh.core.relaying.topologies import chain, online, reported
from tests.udp_mesh.wire.log_vectors import CONTROL
from tests.udp_mesh.wire.make_vectors import RELAY_FRAMES, encode_relay
from udp_mesh.core.events import MessageDelivered, Rejected
from udp_mesh.core.logs.item import ItemId, LogItem, LogKey, encode_item
from udp_mesh.core.logs.messages import Have, HaveEntry, Holder, ItemRequest, encode_control
from udp_mesh.core.logs.serving import MAX_QUEUED
from udp_mesh.core.relaying.hop_queue import MAX_HOP_BYTES
from udp_mesh.core.relaying.relaying import MAX_NEIGHBOURS
from udp_mesh.crypto.signing import SigningKey
from udp_mesh.wire.relay import Carry, encode_carry

LOG_TOPIC = "artifact"


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
        self._source = next(link.address for link in self.topology.nodes["n2"]._relaying.neighbours[one].links.values())

    def receive(self, frame: bytes, *, to_all: bool) -> None:
        """A frame sealed by n1, at n2."""
        data = self._channels.seal_hello(frame) if to_all else self._channels.seal(self._hop, frame)[1]
        self.topology.nodes["n2"].receive(data, "n1", self._source, self.topology.now)

    def run(self, seconds: float) -> None:
        self.topology.run(seconds)

    def check_bounds(self) -> None:
        """Raises AssertionError if the relay holds more than its limits allow, or does not relay any more."""
        relaying = self.topology.nodes["n2"]._relaying
        assert len(relaying.neighbours) <= MAX_NEIGHBOURS
        assert relaying.forwarding.budget.memory_bytes <= MAX_NEIGHBOURS * MAX_HOP_BYTES

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
