"""Passes a program no more messages of a topic than it wants: the newest of each interval.

A peer thins what it sends to the highest rate that any program here wants; the others, and peers of earlier versions,
are thinned here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from udp_mesh.daemon.api import Client

MAX_PACED = 4096
"""Streams of one topic from one source to one program; a holder of the key could invent names. A further one is not
thinned."""
MAX_WAITING_BYTES = 64 << 20
"""Frames that wait for their turn: above it, messages are passed on at once."""

Stream = tuple[str, str]
"""Topic and source."""


class Timer(Protocol):
    def cancel(self) -> None: ...


@dataclass(slots=True)
class _Pace:
    next_at: float
    waiting: bytes | None = None
    timer: Timer | None = None


class Thinning:
    """`clock` and `call_at` are those of the loop."""

    def __init__(self, clock: Callable[[], float], call_at: Callable[[float, Callable[[], None]], Timer]) -> None:
        self._clock = clock
        self._call_at = call_at
        self._paces: dict[Client, dict[Stream, _Pace]] = {}
        self._streams = 0
        self._waiting_bytes = 0

    def send(self, client: Client, stream: Stream, rate_hz: float, frame: bytes) -> None:
        """Send a frame now, or in its turn unless a newer one replaces it."""
        now = self._clock()
        paces = self._paces.setdefault(client, {})
        pace = paces.get(stream)
        if pace is None:
            if self._streams >= MAX_PACED:
                self._forget_idle(now)
            if self._streams < MAX_PACED:
                paces = self._paces.setdefault(client, {})
                paces[stream] = _Pace(now + 1 / rate_hz)
                self._streams += 1
            client.send_encoded(frame)
            return
        self._replace(pace, None)
        pace.next_at = min(pace.next_at, now + 1 / rate_hz)
        if now >= pace.next_at or self._waiting_bytes + len(frame) > MAX_WAITING_BYTES:
            pace.next_at = now + 1 / rate_hz
            client.send_encoded(frame)
            return
        self._replace(pace, frame)
        if pace.timer is None:
            pace.timer = self._call_at(pace.next_at, lambda: self._send_waiting(client, pace, 1 / rate_hz))

    def _send_waiting(self, client: Client, pace: _Pace, interval_s: float) -> None:
        pace.timer = None
        frame = pace.waiting
        if frame is not None:
            self._replace(pace, None)
            pace.next_at = self._clock() + interval_s
            client.send_encoded(frame)

    def _replace(self, pace: _Pace, frame: bytes | None) -> None:
        self._waiting_bytes += len(frame or b"") - len(pace.waiting or b"")
        pace.waiting = frame

    def _forget_idle(self, now: float) -> None:
        for client, paces in list(self._paces.items()):
            for stream, pace in list(paces.items()):
                if pace.waiting is None and pace.next_at <= now:
                    self._forget(client, stream)

    def _forget(self, client: Client, stream: Stream) -> None:
        pace = self._paces[client].pop(stream)
        self._streams -= 1
        self._replace(pace, None)
        if pace.timer is not None:
            pace.timer.cancel()
        if not self._paces[client]:
            del self._paces[client]

    def remove_client(self, client: Client) -> None:
        for stream in list(self._paces.get(client, ())):
            self._forget(client, stream)
        self._paces.pop(client, None)
