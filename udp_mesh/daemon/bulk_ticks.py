"""Reads what is not urgent in ticks while it arrives often, because each wake-up costs more than reading a datagram.

Urgent datagrams, acknowledgments among them, are marked and arrive at another socket (`links.source_filter`), which is
read at once. Where the network removes the marks nothing waits for a tick, and on a path so short that acknowledgments
would come too late neither. What is not urgent is also read whenever something else woke the process, so that datagrams
are processed in the order of their arrival.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from udp_mesh.links.udp import UdpLink

TICK_S = 0.004
"""Between two reads: at 10 Mbit/s three or four full datagrams."""
MIN_DATAGRAMS = 2
"""Fewer datagrams in a tick are not worth waiting for: then the loop watches the socket."""
MAX_DATAGRAMS = 10
"""More datagrams in a tick (about 30 Mbit/s) arrive in batches without ticks, too, and ticks would cost throughput."""
MARKED_VALID_S = 5.0
"""Marks are known to arrive if one did this recently; heartbeats and acknowledgments are marked."""

LATE_SHARE = 0.25
LATE_EXCESS = 3.0
"""If acknowledgments are late in more than this share of ticks, by this many in all, ticks are too long for a path."""
PAUSE_S = 5.0
"""Time until ticks are tried again where they were too long."""

_NEVER = float("-inf")


class AcknowledgingNode(Protocol):
    """The part of `Endpoint` that tells whether ticks are too long."""

    @property
    def late_acknowledgements(self) -> int: ...


class _Reader:
    __slots__ = ("count", "late", "link", "marked_at", "paused_until", "read_at", "tick")

    def __init__(self, link: UdpLink) -> None:
        self.link = link
        self.marked_at = _NEVER
        """When a marked datagram last arrived."""
        self.read_at = _NEVER
        """When the socket was last readable."""
        self.tick: asyncio.TimerHandle | None = None
        """Set while the loop does not watch the socket."""
        self.count = 0
        """Datagrams since the last tick."""
        self.late = 0.0
        """By how many late acknowledgments exceeded their share."""
        self.paused_until = _NEVER

    def may_tick(self, now: float) -> bool:
        return now - self.marked_at < MARKED_VALID_S and now >= self.paused_until


class BulkTicks:
    """One reader per link; `read` passes what waits to the core and returns the number of datagrams."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        node: AcknowledgingNode,
        read: Callable[[UdpLink], int],
        after_read: Callable[[], None],
    ) -> None:
        self._loop = loop
        self._node = node
        self._read = read
        self._after_read = after_read
        self._late = 0
        self._readers: dict[str, _Reader] = {}
        self._ticking: dict[_Reader, None] = {}

    def watch(self, link: UdpLink) -> None:
        """Read from the link's socket."""
        reader = self._readers.get(link.attachment.name)
        if reader is None or reader.link is not link:
            reader = self._readers[link.attachment.name] = _Reader(link)
        if reader.tick is None:
            self._loop.add_reader(link.unmarked_fileno(), self._readable, reader)

    def unwatch(self, link: UdpLink) -> None:
        """The link is about to close."""
        self._loop.remove_reader(link.unmarked_fileno())
        reader = self._readers.get(link.attachment.name)
        if reader is not None and reader.tick is not None:
            reader.tick.cancel()
            reader.tick = None
            del self._ticking[reader]

    def marked_arrived(self, link: UdpLink, now: float) -> None:
        """A marked datagram arrived on the link."""
        self._readers[link.attachment.name].marked_at = now

    def read_ticking(self) -> None:
        """Read what waits for a tick: the process is awake anyway."""
        for reader in self._ticking:
            reader.count += self._read(reader.link)

    def _readable(self, reader: _Reader) -> None:
        now = self._loop.time()
        self._read(reader.link)
        if MIN_DATAGRAMS * (now - reader.read_at) < TICK_S and reader.may_tick(now):
            self._loop.remove_reader(reader.link.unmarked_fileno())
            self._ticking[reader] = None
            reader.count = 0
            reader.late = 0.0
            reader.tick = self._loop.call_at(now + TICK_S, self._tick, reader)
        reader.read_at = now
        self._after_read()

    def _tick(self, reader: _Reader) -> None:
        now = self._loop.time()
        count = reader.count + self._read(reader.link)
        reader.count = 0
        if count > MAX_DATAGRAMS:
            reader.paused_until = now + PAUSE_S
        if count >= MIN_DATAGRAMS and reader.may_tick(now):
            reader.tick = self._loop.call_at(now + TICK_S, self._tick, reader)
        else:
            reader.tick = None
            reader.read_at = now
            del self._ticking[reader]
            self._loop.add_reader(reader.link.unmarked_fileno(), self._readable, reader)
        if count:
            self._after_read()
            self._count_late(reader, now)

    def _count_late(self, reader: _Reader, now: float) -> None:
        late = self._node.late_acknowledgements
        reader.late = max(0.0, reader.late - LATE_SHARE + (late > self._late))
        self._late = late
        if reader.late > LATE_EXCESS:
            reader.paused_until = now + PAUSE_S
