"""One link under the standard load: bulk without end, maps at 5 Hz, urgent messages at 20 Hz -> shares and latencies.

Every sender keeps `UNDER_WAY` bulk messages accepted. `Result.share` is the payload that arrived, of the bytes that the
link could carry in that time.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

from udp_mesh.core.events import Event, MessageReceived
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.crypto import Key
from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.network import Network
from udp_mesh.sim.links.path import Bottleneck, Carrier, HalfDuplexChain, Link
from udp_mesh.sim.links.tcp import SEGMENT_BYTES, TcpController, TcpFlow

TOPICS = (Topic("urgent", priority=0), Topic("map", priority=6), Topic("bulk", priority=8))
BULK_BYTES = 50_000
MAP_BYTES = 10_000
MAP_PERIOD_S = 0.2
URGENT_BYTES = 200
URGENT_PERIOD_S = 0.05
UNDER_WAY = 40
MEET_S = 2.0
"""Time to discover each other before the load starts."""

TIMELINE_STEP_S = 0.5

RECEIVER = "base"
_KEY = Key(bytes(range(32)))


@dataclass(frozen=True, slots=True)
class Chain:
    """Half-duplex hops in a line."""

    hops: int
    rate: float
    overhead_s: float
    hop_loss: float


@dataclass(frozen=True, slots=True)
class Cell:
    """A link, who sends on it, and for how long. The first `warm_up_s` of the load are not measured."""

    name: str
    link: Callable[[int], Link] | None = None
    """Of a seed; the same in both directions."""
    chain: Chain | None = None
    senders: int = 1
    foreign: Callable[[int], TcpController] | None = None
    """A foreign flow beside ours."""
    duration_s: float = 30.0
    warm_up_s: float = 5.0


@dataclass(frozen=True, slots=True)
class Moment:
    """The mean of the step that ends `at_s` after the start of the load."""

    at_s: float
    link_bits_per_s: float | None
    """What the link can carry; None for a chain of hops."""
    goodput_bits_per_s: float
    foreign_bits_per_s: float


@dataclass(slots=True)
class Result:
    share: float = 0.0
    foreign_share: float = 0.0
    urgent_s: list[float] = field(default_factory=list)
    """Latencies of urgent messages sent while the link carried anything, sorted."""
    map_s: list[float] = field(default_factory=list)
    urgent_sent: int = 0
    wire_ratio: float = 0.0
    """IP bytes of both directions per byte of payload."""
    timeline: list[Moment] = field(default_factory=list)
    urgent_at: list[tuple[float, float]] = field(default_factory=list)
    """(when it was sent after the start of the load, latency) of every urgent message that arrived, in seconds."""

    def urgent_p99_s(self) -> float:
        return percentile(self.urgent_s, 0.99)


def percentile(ordered: Sequence[float], fraction: float) -> float:
    """The value below which this fraction lies; infinite without values."""
    return ordered[min(len(ordered) - 1, int(fraction * len(ordered)))] if ordered else float("inf")


class Trial:
    """Call `run` once."""

    def __init__(self, cell: Cell, seed: int) -> None:
        self._cell = cell
        self.event_queue = SimEventQueue()
        rng = random.Random(f"{cell.name} {seed}")
        self.link = cell.link(seed) if cell.link is not None else None
        self._senders = [f"robot{number}" for number in range(1, cell.senders + 1)]
        settings = [Settings(name, keys=(_KEY,), topics=TOPICS) for name in (RECEIVER, *self._senders)]
        self.network = Network(self.event_queue, settings, seed=rng.getrandbits(32), on_event=self._on_event)
        self.forward, self.backward = self._paths(rng)
        for name in self._senders:
            self.network.connect(name, RECEIVER, self.forward)
            self.network.connect(RECEIVER, name, self.backward)
        near = Link()
        for name in self._senders:
            for other in self._senders:
                if other != name:
                    # They hear each other's heartbeats, without passing the bottleneck.
                    self.network.connect(name, other, Bottleneck(self.event_queue, near, rng))
        self._starts_at = MEET_S
        self._ends_at = MEET_S + cell.duration_s
        self._measured_from = MEET_S + cell.warm_up_s
        self._sent_at: dict[tuple[str, bytes], float] = {}
        self._received_bytes = 0
        self._step_bytes = 0
        """Received in the current step of the timeline."""
        self.result = Result()
        self.foreign: TcpFlow | None = None
        if cell.foreign is not None:
            self.foreign = TcpFlow(
                self.event_queue, cell.foreign(seed), self.forward, self.backward, start_s=MEET_S + 1.0
            )

    def _paths(self, rng: random.Random) -> tuple[Carrier, Carrier]:
        chain = self._cell.chain
        if chain is not None:
            line = HalfDuplexChain(
                self.event_queue, rng, hops=chain.hops, rate=chain.rate, overhead_s=chain.overhead_s,
                hop_loss=chain.hop_loss,
            )  # fmt: skip
            return line.forward(), line.backward()
        assert self.link is not None
        return Bottleneck(self.event_queue, self.link, rng), Bottleneck(self.event_queue, self.link, rng)

    def run(self) -> Result:
        queue = self.event_queue
        self.network.start()
        queue.at(self._starts_at, self._begin)
        queue.run_until(self._measured_from)
        foreign_before = self._foreign_bytes()
        wire_before = sum(self.network.bytes_sent.values())
        queue.run_until(self._ends_at)
        carried = self._capacity_bytes()
        result = self.result
        result.share = self._received_bytes / carried
        result.wire_ratio = (sum(self.network.bytes_sent.values()) - wire_before) / max(1, self._received_bytes)
        result.foreign_share = (self._foreign_bytes() - foreign_before) / carried
        result.urgent_s.sort()
        result.map_s.sort()
        return result

    def _capacity_bytes(self) -> float:
        """The most that the link can carry while it is measured."""
        since, until = self._measured_from, self._ends_at
        chain = self._cell.chain
        if chain is not None:
            arriving = 1 - chain.hop_loss
            transmissions = sum(arriving**hop for hop in range(chain.hops)) / arriving**chain.hops
            frame_s = SEGMENT_BYTES * 8 / chain.rate
            return chain.rate * frame_s / (frame_s + chain.overhead_s) * (until - since) / transmissions / 8
        assert self.link is not None
        return self.link.rate.integral(since, until) * (1 - self.link.loss) / 8

    def _begin(self) -> None:
        for index, name in enumerate(self._senders):
            for _ in range(UNDER_WAY):
                self.network.send(name, "bulk", bytes(BULK_BYTES), RECEIVER)
            self._send_every(name, "map", MAP_BYTES, MAP_PERIOD_S, index * 0.013)
            self._send_every(name, "urgent", URGENT_BYTES, URGENT_PERIOD_S, index * 0.007)
            self.network.pump(name)
        self._note_step(self._foreign_bytes())

    def _foreign_bytes(self) -> int:
        return self.foreign.received_bytes if self.foreign is not None else 0

    def _note_step(self, foreign_before: int) -> None:
        """At the start of a step of the timeline: note it at its end."""

        def note() -> None:
            now, foreign = self.event_queue.now, self._foreign_bytes()
            carried = self.link.rate.integral(now - TIMELINE_STEP_S, now) if self.link is not None else None
            self.result.timeline.append(
                Moment(
                    now - self._starts_at,
                    None if carried is None else carried / TIMELINE_STEP_S,
                    self._step_bytes * 8 / TIMELINE_STEP_S,
                    (foreign - foreign_before) * 8 / TIMELINE_STEP_S,
                )
            )
            self._note_step(foreign)

        self._step_bytes = 0
        self.event_queue.after(TIMELINE_STEP_S, note)

    def _send_every(self, name: str, topic: str, size_bytes: int, period_s: float, offset_s: float) -> None:
        def send() -> None:
            now = self.event_queue.now
            if topic == "urgent" and self._counts(now):
                self.result.urgent_sent += 1
            payload = f"{name} {now:.6f}".encode().ljust(size_bytes)
            self._sent_at[topic, payload] = now
            self.network.send(name, topic, payload, RECEIVER)
            self.network.pump(name)
            self.event_queue.after(period_s, send)

        self.event_queue.after(offset_s + period_s, send)

    def _counts(self, sent_at: float) -> bool:
        """Whether a message sent then is measured: late enough, time enough to arrive, not in a fade."""
        if not self._measured_from <= sent_at < self._ends_at - 1.0:
            return False
        return self.link is None or all(
            not start - 0.05 <= sent_at < end + 0.05 for start, end in self.link.rate.spans_of(0.0)
        )

    def _on_event(self, now: float, name: str, event: Event) -> None:
        if not isinstance(event, MessageReceived) or name != RECEIVER:
            return
        self._step_bytes += len(event.payload)
        if now >= self._measured_from:
            self._received_bytes += len(event.payload)
        if event.topic == "bulk":
            self.event_queue.at(now, partial(self._next_bulk, event.source))
            return
        sent_at = self._sent_at.pop((event.topic, bytes(event.payload)), None)
        if sent_at is not None and event.topic == "urgent":
            self.result.urgent_at.append((sent_at - self._starts_at, now - sent_at))
        if sent_at is not None and self._counts(sent_at):
            (self.result.urgent_s if event.topic == "urgent" else self.result.map_s).append(now - sent_at)

    def _next_bulk(self, name: str) -> None:
        self.network.send(name, "bulk", bytes(BULK_BYTES), RECEIVER)
        self.network.pump(name)
