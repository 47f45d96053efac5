"""A radio channel between serial ports, for tests: pseudo-terminals behind a shim with a rate, loss and collisions.

Each port is the device of one daemon's radio. What a daemon writes occupies the channel for its time at the radio's
rate; a frame arrives complete, when it ends, at every other port that did not send and heard no other frame meanwhile.
"""

from __future__ import annotations

import os
import random
import selectors
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(slots=True)
class Port:
    master: int
    slave: int
    device: str
    line: bytearray = field(default_factory=bytearray)
    sends_until: float = 0.0
    sent_s: list[tuple[float, float]] = field(default_factory=list)
    """When each frame began, and its airtime."""


@dataclass(slots=True)
class _Transmission:
    port: Port
    starts: float
    ends: float
    frame: bytes
    delivered: bool = False


class SerialAir:
    """`count` ports; `devices` are the paths for the daemons. `cut` has the ports that are out of range. The radios
    pass bytes through."""

    overhead_bytes = 0
    """What they add to a frame on the air."""
    senses_carrier = False
    """Whether a radio waits until it hears no other one."""

    def __init__(self, count: int, *, bits_per_s: float, loss: float = 0.0, seed: int = 1) -> None:
        self.bits_per_s, self.loss = bits_per_s, loss
        self.rng = random.Random(seed)
        self.cut: set[int] = set()
        self.collided = self.lost = self.delivered = 0
        self.ports = [self._open() for _ in range(count)]
        self.devices = [port.device for port in self.ports]
        self._transmissions: list[_Transmission] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    @staticmethod
    def _open() -> Port:
        master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(master, False)
        # The slave stays open here: a master without one reads EIO.
        return Port(master, slave, os.ttyname(slave))

    def airtimes(self, port: int) -> list[tuple[float, float]]:
        """When each frame of this port began, and how long it occupied the channel."""
        return list(self.ports[port].sent_s)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(10)
        for port in self.ports:
            os.close(port.master)
            os.close(port.slave)

    def inject(self, port: int, line: bytes) -> None:
        """Bytes that this port's daemon reads, as if they had come from the air."""
        os.write(self.ports[port].master, line)

    def _run(self) -> None:
        with selectors.DefaultSelector() as selector:
            for port in self.ports:
                selector.register(port.master, selectors.EVENT_READ, port)
            while not self._stop.is_set():
                for key, _ in selector.select(0.002):
                    self._read(key.data)
                self._deliver(time.monotonic())

    def _read(self, port: Port) -> None:
        try:
            port.line += os.read(port.master, 4096)
        except BlockingIOError:
            return
        for frame in self._taken(port):
            heard = [other.sends_until for other in self.ports if self.senses_carrier and self._hears(port, other)]
            starts = max(time.monotonic(), port.sends_until, *heard)
            airtime_s = 8 * (len(frame) + self.overhead_bytes) / self.bits_per_s
            port.sends_until = starts + airtime_s
            port.sent_s.append((starts, airtime_s))
            self._transmissions.append(_Transmission(port, starts, starts + airtime_s, frame))

    def _hears(self, port: Port, other: Port) -> bool:
        return not {self.ports.index(port), self.ports.index(other)} & self.cut

    def _taken(self, port: Port) -> Iterator[bytes]:
        """The frames that the radio now has completely; they leave `port.line`."""
        while (end := port.line.find(b"\0", 1)) > 0:
            line, port.line = bytes(port.line[: end + 1]), port.line[end + 1 :]
            if line.strip(b"\0"):
                yield line

    def _written(self, frame: bytes) -> bytes:
        """What a radio that received the frame writes to its port."""
        return frame

    def _deliver(self, now: float) -> None:
        for one in self._transmissions:
            if one.delivered or one.ends > now:
                continue
            one.delivered = True
            collided = any(other is not one and _overlap(other, one) for other in self._transmissions)
            for port in self.ports:
                if port is one.port or not self._hears(port, one.port):
                    continue
                if collided:
                    self.collided += 1
                elif self.rng.random() < self.loss:
                    self.lost += 1
                else:
                    self.delivered += 1
                    os.write(port.master, self._written(one.frame))
        # Those that ended stay for a while: they overlap with some that end later.
        self._transmissions = [one for one in self._transmissions if one.ends > now - 5.0]


def _overlap(a: _Transmission, b: _Transmission) -> bool:
    return a.starts < b.ends and b.starts < a.ends


@contextmanager
def running(air: SerialAir) -> Iterator[SerialAir]:
    air.start()
    try:
        yield air
    finally:
        air.stop()
