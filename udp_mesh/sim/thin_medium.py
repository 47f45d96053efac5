"""The channel of a thin link: one frame at a time, half duplex, in a band without carrier sense.

A frame occupies the channel of every station in range for its airtime. Two frames that overlap at a receiver destroy
each other there (no capture), a station that sends hears nothing, and the others lose frames with a probability that
depends on the distance. Nothing is queued: the transport does not send two frames at once.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial

from udp_mesh.core.thin.settings import ThinLinkSettings
from udp_mesh.sim.event_queue import SimEventQueue

Loss = Callable[[str, str, float], float]
"""(station, station, now) -> probability that a frame is lost; 1 if they are out of range."""


@dataclass(slots=True, eq=False)
class _Reception:
    ends_at: float
    damaged: bool = False


@dataclass(slots=True)
class _Station:
    sends_until: float = -1.0
    receptions: list[_Reception] = field(default_factory=list)


@dataclass(slots=True)
class ThinCounters:
    """Counters of the channel since the start; `airtime_s` and `sent` by station."""

    sent: Counter[str] = field(default_factory=Counter)
    airtime_s: dict[str, float] = field(default_factory=dict)
    bytes: int = 0
    delivered: int = 0
    collided: int = 0
    lost: int = 0


class ThinMedium:
    """The channel of all `stations`; `deliver(station, frame)` gets what arrives undamaged."""

    def __init__(
        self,
        event_queue: SimEventQueue,
        link: ThinLinkSettings,
        stations: Iterable[str],
        loss: Loss,
        deliver: Callable[[str, bytes], None],
        rng: random.Random,
    ) -> None:
        self.link = link
        self.counts = ThinCounters()
        self.sent: list[tuple[float, str, float]] = []
        """Each frame: when, by whom, and its airtime."""
        self._event_queue, self._loss, self._deliver, self._rng = event_queue, loss, deliver, rng
        self._stations = {name: _Station() for name in stations}

    def send(self, name: str, frame: bytes) -> None:
        """A station starts to send a frame now."""
        now, airtime_s = self._event_queue.now, self.link.airtime_s(len(frame))
        self.sent.append((now, name, airtime_s))
        self.counts.sent[name] += 1
        self.counts.airtime_s[name] = self.counts.airtime_s.get(name, 0.0) + airtime_s
        self.counts.bytes += len(frame)
        sender = self._stations[name]
        sender.sends_until = max(sender.sends_until, now + airtime_s)
        for reception in sender.receptions:
            reception.damaged = True
        for other, station in self._stations.items():
            loss = self._loss(name, other, now) if other != name else 1.0
            if loss >= 1.0:
                continue
            reception = _Reception(now + airtime_s, damaged=station.sends_until > now)
            for earlier in station.receptions:
                earlier.damaged = reception.damaged = True
            station.receptions.append(reception)
            lost = self._rng.random() < loss
            self._event_queue.after(airtime_s, partial(self._end, other, reception, frame, lost=lost))

    def _end(self, name: str, reception: _Reception, frame: bytes, *, lost: bool) -> None:
        self._stations[name].receptions.remove(reception)
        if reception.damaged:
            self.counts.collided += 1
        elif lost:
            self.counts.lost += 1
        else:
            self.counts.delivered += 1
            self._deliver(name, frame)
