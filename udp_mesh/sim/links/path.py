"""Paths that carry packets of any flow: a bottleneck with a finite queue, and a chain of half-duplex hops.

`Bottleneck` is one direction: a packet joins the queue (or is dropped), is serialized at the current rate, may be lost,
and arrives after the current delay.

- *Retries of a radio* (`Link.stalls_per_s`): now and then a packet arrives later by the time of its retries. The
  receiving radio delivers in order, as with 802.11's block acknowledgment: everything behind it waits and then arrives
  at once.
- *Reordering* (`Link.reorder_share`): the packet alone takes longer; later ones overtake it.
- *MTU*: larger packets vanish without a report.

`HalfDuplexChain` is a line of stations on one channel: one of them sends at a time, each hop loses frames, nothing is
repeated below the transport.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Protocol

from udp_mesh.sim.event_queue import SimEventQueue
from udp_mesh.sim.links.traces import Steps, constant

Deliver = Callable[[], None]


class Carrier(Protocol):
    """One direction of a path."""

    def send(self, packet_bytes: int, deliver: Deliver) -> None:
        """Carry a packet of so many bytes, IP and UDP headers included; `deliver` is called if and when it arrives."""
        ...


@dataclass(frozen=True, slots=True)
class Link:
    """One direction of a link. Rates in bit/s, times in seconds."""

    rate: Steps = field(default_factory=lambda: constant(10e6))
    delay_s: Steps = field(default_factory=lambda: constant(0.010))
    mtu: Steps = field(default_factory=lambda: constant(1500))
    queue_packets: int = 100
    loss: float = 0.0
    stalls_per_s: float = 0.0
    """How often, on average, the radio repeats a packet for long."""
    stall_s: tuple[float, float] = (0.010, 0.030)
    reorder_share: float = 0.0
    reorder_s: tuple[float, float] = (0.002, 0.010)


class Bottleneck:
    """One direction of a link, shared by everything that is sent on it."""

    def __init__(self, event_queue: SimEventQueue, link: Link, rng: random.Random) -> None:
        self._event_queue = event_queue
        self._link = link
        self._rng = rng
        self._queue: deque[tuple[int, Deliver]] = deque()
        self._in_order_at = self._stalls_at = 0.0
        self.queue_drops = 0
        self.carried_bytes = 0

    @property
    def queued(self) -> int:
        """Packets in the queue, the one being sent included."""
        return len(self._queue)

    def send(self, packet_bytes: int, deliver: Deliver) -> None:
        if packet_bytes > self._link.mtu.at(self._event_queue.now):
            return
        if len(self._queue) >= self._link.queue_packets:
            self.queue_drops += 1
            return
        self._queue.append((packet_bytes, deliver))
        if len(self._queue) == 1:
            self._serialize()

    def _serialize(self) -> None:
        now = self._event_queue.now
        rate = self._link.rate.at(now)
        if rate <= 0.0:
            changes_at = self._link.rate.next_change(now)
            if changes_at is not None:
                self._event_queue.at(changes_at, self._serialize)
            return
        self._event_queue.at(now + self._queue[0][0] * 8 / rate, self._sent)

    def _sent(self) -> None:
        packet_bytes, deliver = self._queue.popleft()
        link, rng, now = self._link, self._rng, self._event_queue.now
        self.carried_bytes += packet_bytes
        if rng.random() >= link.loss:
            arrives_at = now + link.delay_s.at(now)
            if link.reorder_share and rng.random() < link.reorder_share:
                arrives_at += rng.uniform(*link.reorder_s)
            elif link.stalls_per_s:
                if now >= self._stalls_at:
                    self._stalls_at = now + rng.expovariate(link.stalls_per_s)
                    arrives_at += rng.uniform(*link.stall_s)
                arrives_at = self._in_order_at = max(arrives_at, self._in_order_at)
            self._event_queue.at(arrives_at, deliver)
        if self._queue:
            self._serialize()


class HalfDuplexChain:
    """`hops` + 1 stations in a line on one channel; station 0 and the last are the ends."""

    def __init__(
        self,
        event_queue: SimEventQueue,
        rng: random.Random,
        *,
        hops: int,
        rate: float,
        overhead_s: float,
        hop_loss: float,
        queue_packets: int = 100,
    ) -> None:
        self._event_queue = event_queue
        self._rng = rng
        self._last = hops
        self._rate = rate
        self._overhead_s = overhead_s
        self._hop_loss = hop_loss
        self._queue_packets = queue_packets
        self._queues: list[deque[tuple[int, int, Deliver]]] = [deque() for _ in range(hops + 1)]
        self._is_busy = False
        self.frames = 0

    def forward(self) -> Carrier:
        return _ChainEnd(self, 0, 1)

    def backward(self) -> Carrier:
        return _ChainEnd(self, self._last, -1)

    def enqueue(self, station: int, step: int, packet_bytes: int, deliver: Deliver) -> None:
        """Queue a packet at a station; `step` is its direction along the line."""
        queue = self._queues[station]
        if len(queue) >= self._queue_packets:
            return
        queue.append((packet_bytes, step, deliver))
        if not self._is_busy:
            self._transmit()

    def _transmit(self) -> None:
        waiting = [station for station, queue in enumerate(self._queues) if queue]
        self._is_busy = bool(waiting)
        if not waiting:
            return
        station = self._rng.choice(waiting)
        packet_bytes, step, deliver = self._queues[station].popleft()
        self.frames += 1
        air_s = self._overhead_s + packet_bytes * 8 / self._rate
        self._event_queue.after(air_s, partial(self._transmitted, station + step, step, packet_bytes, deliver))

    def _transmitted(self, station: int, step: int, packet_bytes: int, deliver: Deliver) -> None:
        self._is_busy = False
        if self._rng.random() >= self._hop_loss:
            if station in (0, self._last):
                deliver()
            else:
                self.enqueue(station, step, packet_bytes, deliver)
        if not self._is_busy:
            self._transmit()


class _ChainEnd:
    def __init__(self, chain: HalfDuplexChain, station: int, step: int) -> None:
        self._chain = chain
        self._station = station
        self._step = step

    def send(self, packet_bytes: int, deliver: Deliver) -> None:
        self._chain.enqueue(self._station, self._step, packet_bytes, deliver)
