"""A shared half-duplex radio channel with a layer-2 mesh: datagrams in at one station, out at others.

A datagram joins its station's finite queue. The station waits for silence, backs off a random number of slots, and
sends the frame to the next hop with up to `attempts` tries, as in 802.11; all stations in range defer meanwhile. The
back-off counter pauses while others send and then resumes, so that no station waits much longer than others (IEEE
802.11-2020, 10.3.4.3). The next hop queues the frame in turn. Routes minimize the expected number of transmissions and
are recomputed every `route_s`, which models the mesh layer's convergence time. A broadcast is flooded: each station
forwards it once, with `broadcast_repeats` transmissions and without acknowledgment.

Each station has two queues, for the access categories video and best effort (IEEE 802.11 EDCA; every 802.11n radio has
them, and the daemon marks urgent datagrams for the former): urgent frames do not wait behind others and use a smaller
contention window. `access_categories=False` models a radio without them.

Not modeled: collisions, hidden stations, capture, rate adaptation.
"""

from __future__ import annotations

import heapq
import random
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

from udp_mesh.sim.event_queue import SimEventQueue

# IP and UDP headers, and the overhead of 802.11 and batman-adv per frame
IP_UDP_BYTES = 28
FRAME_BYTES = 68
# 802.11n at 2.4 GHz: slot time; AIFS slots before the back-off and the minimum contention window, for best effort and
# for video (IEEE 802.11-2020, table 9-155; the two slots common to both are part of a transmission's overhead)
SLOT_S = 9e-6
BEST_EFFORT_SLOTS = (1, 16)
VIDEO_SLOTS = (0, 8)
# In slots: sums of floats fall this short of whole numbers.
_ROUNDING = 1e-3


@dataclass(frozen=True, slots=True)
class RadioChannel:
    """`rate` is the bit rate on the air, `overhead_s` the time per transmission for preamble, spacing and ACK."""

    rate: float = 20e6
    overhead_s: float = 100e-6
    queue_frames: int = 200
    attempts: int = 8
    broadcast_repeats: int = 1
    route_s: float = 1.0
    hop_delay_s: float = 0.0005
    access_categories: bool = True


@dataclass(slots=True)
class RadioFrame:
    """A datagram in transit; `to` None means broadcast."""

    number: int
    source: str
    to: str | None
    data: bytes
    urgent: bool = False


@dataclass(slots=True)
class ChannelCounters:
    """Counters of the whole channel since the start."""

    transmissions: int = 0
    bytes: int = 0
    airtime_s: float = 0.0
    airtime_s_of: dict[str, float] = field(default_factory=dict)
    """By sending station."""
    queue_drops: int = 0
    losses: int = 0
    unroutable: int = 0


@dataclass(slots=True)
class _Queue:
    """One access category of one station."""

    station: _Station
    slots: tuple[int, int]
    frames: deque[RadioFrame] = field(default_factory=deque)
    is_waiting: bool = False
    backoff_slots: int | None = None
    """Slots left before the first frame may be sent; None: not drawn yet."""
    counting_from_s: float = 0.0


class _Station:
    def __init__(self, name: str) -> None:
        self.name = name
        self.urgent = _Queue(self, VIDEO_SLOTS)
        self.other = _Queue(self, BEST_EFFORT_SLOTS)
        self.quiet_from_s = self.quiet_until_s = 0.0
        """The latest interval in which another station was heard sending."""
        self.is_on = True
        self.flooded: deque[int] = deque(maxlen=512)


Loss = Callable[[str, str, float], float]
"""(station, station, now) -> probability that a frame is lost; 1 if they are out of range."""
DeliverFrame = Callable[[str, RadioFrame], None]


class Medium:
    """The channel of all `stations`; `loss` gives the loss between two, `deliver` gets what arrives at a station."""

    def __init__(
        self,
        event_queue: SimEventQueue,
        channel: RadioChannel,
        stations: Iterable[str],
        loss: Loss,
        deliver: DeliverFrame,
        rng: random.Random,
    ) -> None:
        self.counts = ChannelCounters()
        self._event_queue = event_queue
        self._channel = channel
        self._stations = {name: _Station(name) for name in stations}
        self._loss = loss
        self._deliver = deliver
        self._rng = rng
        self._frames = 0
        self._routed_at_s = -1.0
        self._next_hops: dict[str, dict[str, str]] = {}
        self._heard: dict[str, dict[str, float]] = {}

    def set_on(self, station: str, on: bool) -> None:
        """Turns a station's radio on or off; turning it off drops its queues."""
        found = self._stations[station]
        found.is_on = on
        if not on:
            found.urgent.frames.clear()
            found.other.frames.clear()
        self._routed_at_s = -1.0

    def links(self) -> dict[str, dict[str, float]]:
        """Current links: for each station those in range, with the frame loss."""
        self._update_routes()
        return self._heard

    def hops(self, a: str, b: str) -> int | None:
        """Number of hops on the current routes; None if there is no route."""
        self._update_routes()
        count = 0
        while a != b:
            step = self._next_hops.get(b, {}).get(a)
            if step is None or count > len(self._stations):
                return None
            a, count = step, count + 1
        return count

    def send(self, source: str, to: str | None, data: bytes, *, urgent: bool = False) -> None:
        """Sends one datagram; a full queue drops it silently, as a radio does."""
        self._frames += 1
        frame = RadioFrame(self._frames, source, to, data, urgent and self._channel.access_categories)
        station = self._stations[source]
        if to is None:
            station.flooded.append(frame.number)
        self._enqueue(station, frame)

    def _enqueue(self, station: _Station, frame: RadioFrame) -> None:
        if not station.is_on:
            return
        queue = station.urgent if frame.urgent else station.other
        if len(queue.frames) >= self._channel.queue_frames:
            self.counts.queue_drops += 1
            return
        queue.frames.append(frame)
        self._contend(queue)

    def _contend(self, queue: _Queue) -> None:
        """Contends for the channel after the next silence and a random or the remaining back-off."""
        if queue.is_waiting or not queue.frames:
            return
        queue.is_waiting = True
        first, window = queue.slots
        if queue.backoff_slots is None:
            queue.backoff_slots = self._rng.randrange(window)
        queue.counting_from_s = max(self._event_queue.now, queue.station.quiet_until_s) + first * SLOT_S
        self._event_queue.at(queue.counting_from_s + queue.backoff_slots * SLOT_S, partial(self._transmit, queue))

    def _transmit(self, queue: _Queue) -> None:
        queue.is_waiting = False
        station = queue.station
        if not queue.frames or not station.is_on:
            queue.backoff_slots = None
            return
        if station.quiet_until_s > self._event_queue.now:
            assert queue.backoff_slots is not None
            counted = (station.quiet_from_s - queue.counting_from_s) / SLOT_S
            queue.backoff_slots -= min(queue.backoff_slots, max(0, int(counted + _ROUNDING)))
            self._contend(queue)
            return
        queue.backoff_slots = None
        self._update_routes()
        frame = queue.frames.popleft()
        if frame.to is None:
            self._broadcast(station, frame)
        else:
            self._forward(station, frame)
        self._contend(queue)

    def _occupy(self, station: _Station, frame: RadioFrame, times: int) -> float:
        """Occupies the channel around a station for `times` transmissions; returns the end of the last."""
        size = len(frame.data) + IP_UDP_BYTES + FRAME_BYTES
        took_s = times * (size * 8 / self._channel.rate + self._channel.overhead_s)
        end_s = self._event_queue.now + took_s
        self._defer(station, end_s)
        for name in self._heard[station.name]:
            self._defer(self._stations[name], end_s)
        self.counts.transmissions += times
        self.counts.bytes += size * times
        self.counts.airtime_s += took_s
        self.counts.airtime_s_of[station.name] = self.counts.airtime_s_of.get(station.name, 0.0) + took_s
        return end_s + self._channel.hop_delay_s

    def _defer(self, station: _Station, end_s: float) -> None:
        if station.quiet_until_s <= self._event_queue.now:
            station.quiet_from_s = self._event_queue.now
        station.quiet_until_s = max(station.quiet_until_s, end_s)

    def _forward(self, station: _Station, frame: RadioFrame) -> None:
        assert frame.to is not None
        step = self._next_hops.get(frame.to, {}).get(station.name)
        if step is None:
            self.counts.unroutable += 1
            return
        # The current loss, which the routes may not reflect yet.
        loss = self._loss(station.name, step, self._event_queue.now) if self._stations[step].is_on else 1.0
        attempts, arrived = 0, False
        while attempts < self._channel.attempts and not arrived:
            attempts += 1
            arrived = self._rng.random() >= loss
        at_s = self._occupy(station, frame, attempts)
        if arrived:
            self._event_queue.at(at_s, lambda: self._arrive(self._stations[step], frame))
        else:
            self.counts.losses += 1

    def _broadcast(self, station: _Station, frame: RadioFrame) -> None:
        at_s = self._occupy(station, frame, self._channel.broadcast_repeats)
        for name, loss in self._heard[station.name].items():
            if self._rng.random() >= loss**self._channel.broadcast_repeats:
                other = self._stations[name]
                self._event_queue.at(at_s, partial(self._arrive, other, frame))

    def _arrive(self, station: _Station, frame: RadioFrame) -> None:
        if not station.is_on:
            return
        if frame.to == station.name:
            self._deliver(station.name, frame)
        elif frame.to is not None:
            self._enqueue(station, frame)
        elif frame.number not in station.flooded:
            station.flooded.append(frame.number)
            self._deliver(station.name, frame)
            if len(self._heard[station.name]) > 1:
                self._enqueue(station, frame)

    def _update_routes(self) -> None:
        """Measures every link and recomputes the routes, at most every `route_s`."""
        now = self._event_queue.now
        if self._routed_at_s >= 0 and now - self._routed_at_s < self._channel.route_s:
            return
        self._routed_at_s = now
        on = [name for name, station in self._stations.items() if station.is_on]
        self._heard = {name: {} for name in self._stations}
        for index, a in enumerate(on):
            for b in on[index + 1 :]:
                loss = self._loss(a, b, now)
                if loss < 1.0:
                    self._heard[a][b] = self._heard[b][a] = loss
        self._next_hops = {to: self._next_hops_to(to) for to in on}

    def _next_hops_to(self, to: str) -> dict[str, str]:
        """Each station's next hop on the route with the fewest expected transmissions (Dijkstra from `to`)."""
        cost = {to: 0.0}
        steps: dict[str, str] = {}
        waiting = [(0.0, to)]
        while waiting:
            so_far, name = heapq.heappop(waiting)
            if so_far > cost[name]:
                continue
            for other, loss in self._heard[name].items():
                through = so_far + 1.0 / (1.0 - loss)
                if through < cost.get(other, float("inf")):
                    cost[other], steps[other] = through, name
                    heapq.heappush(waiting, (through, other))
        return steps
