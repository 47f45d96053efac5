"""Random teams in virtual time: nodes on random networks, what happens to them, and what they were promised.

Nodes, some of them relays, send messages of every kind of topic while networks fail, lose, duplicate, reorder and
narrow; nodes die, restart, leave and are suspended; disks hang and programs stop reading; settings and subscriptions
change. Every message is accounted for: an outcome that must not be, and a message that arrives twice, raise `Broken`.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

from tests.udp_mesh.core.relaying.topologies import KEY
from tests.udp_mesh.disk import Disk
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import (
    Event,
    ExpiryReason,
    MessageDelivered,
    MessageExpired,
    MessagePeerLost,
    MessageReceived,
    PathNarrowed,
    Receipt,
)
from udp_mesh.core.interfaces import Datagram, StoredMessage
from udp_mesh.core.logs.store import MemoryLogStore
from udp_mesh.core.settings import LinkInfo, LinkKind, Log, Outbox, Rates, RelaySettings, Settings, Topic
from udp_mesh.core.subscriptions.messages import Bounds, Subscription
from udp_mesh.crypto import Key
from udp_mesh.sim.topology import Topology

NEXT_KEY = Key(bytes(range(1, 33)))
RATES = Rates(offline_s=3.0, peer_lost_s=8.0, heartbeat_sparse_s=1.0)
TOPICS = (
    Topic("stop", priority=0),
    Topic("pose", priority=2, keep_last=1, deadline_s=0.5),
    Topic("order", priority=3, deadline_s=3.0),
    Topic("status", priority=4, keep_last=2),
    Topic("view", priority=5, reliable=False),
    Topic("kept", priority=6, outbox=Outbox.ALL, outbox_bytes=2_000_000),
    Topic("newest", priority=6, outbox=Outbox.LAST),
    Topic("stored", priority=7, outbox=Outbox.ALL, outbox_on_disk=True),
    Topic("limited", priority=7, rate_limit_bytes_per_s=40_000),
    Topic("map", priority=9, compression=True),
    Topic("grid", priority=10, delta=True),
    Topic("alert", priority=1, repair=True, reliable=False),
)
OUTBOXES = {topic.name for topic in TOPICS if topic.outbox is not Outbox.NONE}
LOG = Topic("artifact", priority=4, log=Log(readers=("a", "b")))
CHANGES = (
    *("down", "loss", "one-way", "jitter", "path-mtu", "link-mtu", "rate"),
    *("kill", "leave", "suspend", "disk", "read", "wants", "apply", "keys", "unplug"),
)
MAX_PAST_TIMERS = 3
SMALL, LARGE = (20, 100, 100, 300, 1_380, 1_400), (1_420, 9_000, 60_000, 200_000)


class Broken(AssertionError):
    """Something that must hold did not."""


@dataclass
class Sent:
    """One accepted message for one destination."""

    source: str
    topic: str
    key: bytes
    at: float
    ends: list[str] = field(default_factory=list)


class SlowDisk(Disk):
    """While it hangs, what is put is not written; a crash loses that."""

    def __init__(self) -> None:
        super().__init__()
        self.hangs = False
        self.unwritten: set[int] = set()

    def put(self, message: StoredMessage) -> bool:
        if self.hangs:
            self.unwritten.add(message.key)
        return super().put(message)

    def crash(self) -> None:
        for key in self.unwritten:
            self.kept.pop(key, None)
        self.unwritten.clear()

    def recover(self) -> None:
        self.hangs = False
        self.unwritten.clear()


class RandomTeam(Topology):
    """A team that follows from its seed."""

    topics: tuple[Topic, ...] = TOPICS

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.dice = random.Random(seed)
        self.homes: dict[str, tuple[str, ...]] = {}
        self.config: dict[str, Settings] = {}
        self.disks: dict[str, SlowDisk] = {}
        self.log_stores: dict[str, MemoryLogStore] = {}
        self.runs: Counter[str] = Counter()
        self.sent: dict[tuple[str, int, int, str], Sent] = {}
        """By source, its run, message id and destination."""
        self.received: dict[str, Counter[tuple[int, bytes]]] = {}
        """By receiver: (its run, key of the message)."""
        self.arrived: dict[str, set[bytes]] = {}
        self.confirmed: dict[str, set[bytes]] = {}
        """By receiver: what it received and confirmed in any run."""
        self.asked_again: set[bytes] = set()
        self.narrowed: set[tuple[str, str]] = set()
        """(sender, receiver): large datagrams vanished on the path, so that messages were started again in smaller
        ones, although they may have arrived before that."""
        self.unread: dict[str, list[tuple[Endpoint, Receipt, bytes]]] = {}
        self.to_all: dict[tuple[str, int, int], bytes] = {}
        """By source, its run and message id: the keys of messages to all, and of best-effort ones."""
        self.broadcast: set[bytes] = set()
        """Those keys."""
        self.reading: set[str] = set()
        self.suspended: dict[str, Endpoint] = {}
        self.datagrams: Counter[str] = Counter()
        self.wakeups: Counter[str] = Counter()
        """By node: how often its timer came."""
        self.serial = 0
        self.timers_late_s = (0.0, 0.001, 0.05)[seed % 3]
        self._starting: list[tuple[str, Event]] | None = None
        self._past_timers: Counter[str] = Counter()
        """By node: how often in a row its next timer was in the past after it did what was due."""
        self.on_event = self._on_event
        self.on_datagram = self._on_datagram
        self._build()

    # The team

    def _build(self) -> None:
        dice = self.dice
        names = ["a", "b", "c", "d"][: dice.randint(2, 4)]
        networks = [f"net{number}" for number in range(dice.choice((1, 1, 2, 3)))]
        for network in networks:
            self.network(
                network,
                loss=dice.choice((0.0, 0.0, 0.02, 0.2)),
                rate_bits_per_s=dice.choice((1e6, 5e6, 20e6)),
                delay_s=dice.choice((0.001, 0.01, 0.1)),
            )
        logs = dice.random() < 0.25
        for place, name in enumerate(names):
            homes = dice.sample(networks, dice.randint(1, len(networks)))
            # A line of networks, so that everyone is connected, if need be through relays.
            line = networks[min(place, len(networks) - 1)], networks[max(0, min(place, len(networks) - 1) - 1)]
            self.homes[name] = tuple(dict.fromkeys([*homes, *line]))
            topics = (*self.topics, LOG) if logs else self.topics
            settings = Settings(
                name=name,
                keys=(KEY,),
                topics=topics,
                undeclared=Topic("any"),
                confirms=True,
                selective=dice.random() < 0.5,
                relay=RelaySettings(all=len(networks) > 1 or dice.random() < 0.2),
                rates=RATES,
            )
            self.config[name] = self.equipped(place, settings)
            self.disks[name] = SlowDisk()
            self.log_stores[name] = MemoryLogStore(self.rng.randbytes(32), clock=lambda: self.now)
            self.received[name], self.unread[name] = Counter(), []
            self.arrived[name], self.confirmed[name] = set(), set()
            self.reading.add(name)
            self.start(name)

    def equipped(self, place: int, settings: Settings) -> Settings:
        """The settings of a node with what else its computer has."""
        return settings

    def start(self, name: str) -> None:
        """Start a node that does not run."""
        self.runs[name] += 1
        self.clocks[name] = self.dice.uniform(0, 1e6)
        self.unread[name].clear()
        disk = self.disks[name]
        kept = disk.load()
        self._starting = []
        node = self.add(
            self.config[name],
            self.homes[name],
            store=disk,
            log_store=self.log_stores[name],
            background=self._in_background,
        )
        events, self._starting = self._starting, None
        first = self._restored_from(node, kept)
        for number, stored in enumerate(kept):
            self._record(name, first + number, stored.peer, stored.topic, stored.payload)
        for source, event in events:
            self._on_event(source, event, self.now)

    def _restored_from(self, node: Endpoint, kept: list[StoredMessage]) -> int:
        """The id of the first message that came from the disk: they have the last ids so far."""
        return node._state.next_message_id - len(kept)

    def _wake(self, name: str, node: Endpoint, at: float) -> None:
        if self.nodes.get(name) is not node or self._wakes_at[name] != at:
            return
        super()._wake(name, node, at)
        self.check_timer(name, node)

    def check_timer(self, name: str, node: Endpoint) -> None:
        """After a node did what was due: its next timer is not due again at once, unless it is few times in a row."""
        self.wakeups[name] += 1
        due = node.next_timer()
        # Compression and the like are due at once until they are done.
        if due is None or due == float("-inf") or due > self.clock(name):
            self._past_timers[name] = 0
            return
        self._past_timers[name] += 1
        if self._past_timers[name] > MAX_PAST_TIMERS:
            raise Broken(f"{name} runs in circles: its next timer stays {self.clock(name) - due:.6f} s in the past")

    def kill(self, name: str, *, politely: bool = False) -> None:
        """End a run. What it had neither ended nor on disk has no outcome."""
        if politely:
            self.nodes[name].close(self.clock(name))
            self.pump(name)
            self.disks[name].recover()
        else:
            self.disks[name].crash()
        self.stop(name)
        run = self.runs[name]
        for key, sent in list(self.sent.items()):
            if key[:2] == (name, run) and not sent.ends:
                if politely and sent.key not in {key_of(kept.payload) for kept in self.disks[name].kept.values()}:
                    raise Broken(f"{sent} has no outcome although its node was closed")
                del self.sent[key]

    # Messages

    def _record(self, source: str, message_id: int, peer: str, topic: str, payload: bytes) -> None:
        self.sent[source, self.runs[source], message_id, peer] = Sent(source, topic, key_of(payload), self.now)

    def publish(self, source: str, topic: Topic, target: str | None) -> None:
        self.serial += 1
        size = self.dice.choice(LARGE if self.dice.random() < 0.15 else SMALL)
        key = b"%s %d %d|" % (source.encode(), self.runs[source], self.serial)
        filler = self.dice.randbytes(max(0, size - len(key)) // 2)
        payload = key + filler + bytes(max(0, size - len(key) - len(filler)))
        if topic.delta:
            # Mostly what was sent before.
            payload = key + bytes(range(256)) * (size // 256)
        self._starting = []
        result = self.send(source, topic.name, payload, target)
        events, self._starting = self._starting, None
        if isinstance(result, int):
            if topic.reliable and target is not None:
                self._record(source, result, target, topic.name, payload)
            else:
                self.to_all[source, self.runs[source], result] = key_of(payload)
                self.broadcast.add(key_of(payload))
        for name, event in events:
            self._on_event(name, event, self.now)

    def _on_event(self, name: str, event: Event, now: float) -> None:
        if self._starting is not None:
            self._starting.append((name, event))
        elif isinstance(event, MessageReceived):
            self._on_received(name, event)
        elif isinstance(event, MessageDelivered | MessageExpired | MessagePeerLost):
            self._on_outcome(name, event)
        elif isinstance(event, PathNarrowed):
            self.narrowed.add((name, event.peer))

    def _on_received(self, name: str, event: MessageReceived) -> None:
        if b"|" not in event.payload[:40]:
            raise Broken(f"{name} received something that nobody sent: {event.payload[:40]!r}")
        key = key_of(event.payload)
        got = self.runs[name], key
        self.received[name][got] += 1
        self.arrived[name].add(key)
        # A message to all that is broadcast and kept in an outbox for a node that hears it nevertheless.
        held = key in self.broadcast and event.topic in OUTBOXES
        # A sender that died before it had an outcome sends what it has on disk again.
        again = event.topic == "stored" and int(key.split()[1]) != self.runs[event.source]
        known = key in self.asked_again or (event.source, name) in self.narrowed or held or again
        if self.received[name][got] > 1 and not known:
            raise Broken(f"{name} received {key!r} of {event.topic} twice")
        if event.receipt is not None:
            self.unread[name].append((self.nodes[name], event.receipt, key))
            if name in self.reading:
                self.event_queue.after(self.dice.choice((0.0, 0.01, 0.5)), lambda: self.read(name))

    def read(self, name: str) -> None:
        """The programs of a node take what came, or cannot keep it."""
        if name in self.suspended:
            return
        unread, self.unread[name] = self.unread[name], []
        for node, receipt, key in unread:
            if self.nodes.get(name) is not node:
                continue
            if self.dice.random() < 0.05:
                self.asked_again.add(key)
                node.request_again(receipt)
            else:
                self.confirmed[name].add(key)
                node.confirm(receipt)
        self.pump(name)

    def _on_outcome(self, name: str, event: MessageDelivered | MessageExpired | MessagePeerLost) -> None:
        run = self.runs[name]
        sent = self.sent.get((name, run, event.message_id, event.peer))
        if sent is None:
            key = self.to_all.get((name, run, event.message_id))
            if key is None:
                raise Broken(f"{name} reported {event}, which it never sent")
            sent = self.sent[name, run, event.message_id, event.peer] = Sent(name, event.topic, key, self.now)
        what = event.reason.value if isinstance(event, MessageExpired) else type(event).__name__
        sent.ends.append(what)
        if len(sent.ends) > 1:
            raise Broken(f"{sent} to {event.peer} ended again")
        if isinstance(event, MessageExpired) and event.reason in (ExpiryReason.REFUSED, ExpiryReason.DISK):
            raise Broken(f"{sent} to {event.peer}: {what}")
        if isinstance(event, MessageDelivered):
            key = sent.key
            if key not in self.arrived[event.peer]:
                raise Broken(f"{sent} was reported as delivered, but {event.peer} did not receive it")
            if event.topic == "stored" and key not in self.confirmed[event.peer]:
                raise Broken(f"{sent} was reported as delivered, but {event.peer} did not confirm it")

    # What happens

    def change(self) -> None:
        """One random change."""
        dice = self.dice
        network = dice.choice(list(self.networks.values()))
        name = dice.choice(list(self.homes))
        match dice.choice(CHANGES):
            case "down":
                network.up = False
                self.event_queue.after(
                    dice.uniform(0.1, dice.choice((1.0, 5.0, 60.0))), lambda: setattr(network, "up", True)
                )
            case "loss":
                network.loss = dice.choice((0.0, 0.02, 0.2, 0.5))
            case "one-way":
                pair = tuple(dice.sample(list(self.homes), 2))
                network.losses[pair[0], pair[1]] = dice.choice((0.0, 0.5, 1.0))
            case "jitter":
                network.jitter_s, network.duplicates = dice.choice((0.0, 0.005, 0.1)), dice.choice((0.0, 0.02, 0.3))
            case "path-mtu":
                network.mtu = dice.choice((1500, 1300, 1000, 700))
            case "link-mtu" if name in self.nodes and name in network.members:
                link = LinkInfo(
                    network.name,
                    LinkKind.BROADCAST,
                    network.address(name),
                    network.broadcast,
                    dice.choice((1500, 1280)),
                )
                self.nodes[name].link_up(link, self.clock(name))
                self.pump(name)
            case "rate":
                network.rate_bits_per_s, network.delay_s = (
                    dice.choice((0.5e6, 5e6, 20e6)),
                    dice.choice((0.001, 0.02, 0.3)),
                )
            case "kill" | "leave" as how if name in self.nodes:
                self.kill(name, politely=how == "leave")
                self.event_queue.after(dice.choice((0.0, 0.5, 5.0, 20.0)), lambda: self._start_again(name))
            case "suspend" if name in self.nodes:
                self.suspended[name] = self.suspend(name)
                self.event_queue.after(dice.choice((0.05, 2.0, 20.0)), lambda: self._continue(name))
            case "disk":
                disk = self.disks[name]
                if disk.hangs:
                    disk.recover()
                else:
                    disk.hangs = True
            case "read":
                if name not in self.reading:
                    self.reading.add(name)
                    self.read(name)
                else:
                    self.reading.discard(name)
            case "wants" if name in self.nodes:
                topics = dice.sample(self.topics, dice.randint(0, len(self.topics)))
                self.nodes[name].selective.set_subscriptions(
                    [Subscription(topic.name, Bounds(dice.choice((None, None, 2.0)), None)) for topic in topics],
                    self.clock(name),
                )
                self.pump(name)
            case "apply" if name in self.nodes:
                self._apply(name)
            case "keys" if name in self.nodes:
                self._rekey(name, dice.choice(((KEY,), (KEY, NEXT_KEY), (NEXT_KEY, KEY), (NEXT_KEY,))))
            case "unplug" if name in self.nodes and name in network.members:
                self.nodes[name].link_down(network.name, self.clock(name))
                self.pump(name)
                self.event_queue.after(dice.choice((0.1, 10.0)), lambda: self._plug_in(name, network.name))
            case _:
                pass

    def _apply(self, name: str) -> None:
        """Other priorities, another limit, another window, smaller fragments."""
        dice = self.dice
        config = self.config[name]
        topics = [
            replace(topic, priority=dice.randint(0, 15)) if topic.log is None and dice.random() < 0.3 else topic
            for topic in config.topics
        ]
        self.config[name] = replace(
            config,
            topics=tuple(topics),
            window=3 if dice.random() < 0.3 else "adaptive",
            fragment_bytes=dice.choice((1400, 1400, 600)),
        )
        self.nodes[name].apply(self.config[name], self.clock(name))
        self.pump(name)

    def _rekey(self, name: str, keys: tuple[Key, ...]) -> None:
        """A node gets its new key, or loses the old one, before or after others."""
        self.config[name] = replace(self.config[name], keys=keys)
        self.nodes[name].apply(self.config[name], self.clock(name))
        self.pump(name)

    def _plug_in(self, name: str, network: str) -> None:
        if name in self.nodes:
            self.connect(name, network)
            self.pump(name)

    def _in_background(self, work: Callable[[], None]) -> Callable[[], bool]:
        """Work beside a node, which takes a while; then the node is woken, as a driver does."""
        work()
        done_at = self.now + self.dice.choice((0.0, 0.02, 0.5))
        for name in self.homes:
            self.event_queue.at(done_at + 1e-6, partial(self.wake, name))
        return lambda: self.now >= done_at

    def _start_again(self, name: str) -> None:
        if name not in self.nodes and name not in self.suspended:
            self.start(name)

    def _continue(self, name: str) -> None:
        if name in self.suspended:
            self.resume(self.suspended.pop(name))
            if name in self.reading:
                self.read(name)

    def repair(self) -> None:
        """All networks, nodes, disks and programs work."""
        for network in self.networks.values():
            network.up, network.loss, network.jitter_s, network.duplicates = True, 0.0, 0.0, 0.0
            network.rate_bits_per_s, network.delay_s, network.mtu = 5e6, 0.005, 1500
            network.losses.clear()
        for name, home in self.homes.items():
            self.disks[name].recover()
            self._continue(name)
            self._start_again(name)
            self._rekey(name, (KEY, NEXT_KEY))
            for link in home:
                self.connect(name, link)
            self.reading.add(name)
            self.read(name)

    # What is left

    @property
    def arrived_at(self) -> float:
        """When the datagram that is being received arrived."""
        return self.now

    def _on_datagram(self, name: str, network: str, datagram: Datagram, now: float) -> None:
        self.datagrams[name] += 1

    def unfinished(self) -> list[tuple[tuple[str, int, int, str], Sent]]:
        return [(key, sent) for key, sent in self.sent.items() if not sent.ends]

    def queued_bytes(self) -> int:
        return sum(
            node.conditions(self.clock(name)).queued_bytes
            + sum(state.bytes for state in (node._state.outboxes, node._state.compression_queue))
            for name, node in self.nodes.items()
        )

    def partial_bytes(self) -> int:
        return sum(node.conditions(self.clock(name)).partial_bytes for name, node in self.nodes.items())


def key_of(payload: bytes) -> bytes:
    return payload[: payload.index(b"|")]
