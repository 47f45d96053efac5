"""Reads from strangers at a limited share of the time during a flood.

If most of what a wake-up read from addresses of no known peer proves to come from no peer (forged, replayed,
foreign, or in the unauthenticated legacy format), only a few datagrams are read at a time, with pauses in between. The
kernel drops what its queue cannot hold meanwhile.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from udp_mesh.links.udp import UdpLink

log = logging.getLogger(__name__)

FLOOD_DATAGRAMS = 16
"""So many unauthenticated datagrams in one wake-up are a flood."""
FLOOD_BATCH = 12
"""During a flood, at most so many are read at a time: an urgent message waits for one such batch at most."""
PAUSE = 4.0
"""Time without reading after each batch, in multiples of what the batch took: a fifth of the time goes to a flood."""
MIN_PAUSE_S, MAX_PAUSE_S = 0.001, 0.5
"""A batch that took longer than the pauses allow was interrupted, for example because the process was suspended."""
LOG_INTERVAL_S = 60.0


class StrangerThrottle:
    """One reader per link; `read` passes at most so many datagrams to the core and returns their number."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        read: Callable[[UdpLink, int], int],
        unauthenticated: Callable[[], int],
        *,
        batch: int,
    ) -> None:
        """`unauthenticated` counts since the start; `batch` is the limit of a read without a flood."""
        self._loop = loop
        self._read = read
        self._unauthenticated = unauthenticated
        self._batch = batch
        self.flooded: set[str] = set()
        """Links with a flood in the last wake-up."""
        self._pauses: dict[str, asyncio.TimerHandle] = {}
        self._logged_at = float("-inf")

    @property
    def paused(self) -> bool:
        """Whether a link's strangers are not read at the moment."""
        return bool(self._pauses)

    def watch(self, link: UdpLink) -> None:
        """Read from the link's strangers, at once or after its pause."""
        if link.attachment.name not in self._pauses:
            self._loop.add_reader(link.strangers_fileno(), self._readable, link)

    def unwatch(self, link: UdpLink) -> None:
        """The link is about to close."""
        self._loop.remove_reader(link.strangers_fileno())
        pause = self._pauses.pop(link.attachment.name, None)
        if pause is not None:
            pause.cancel()

    def _readable(self, link: UdpLink) -> None:
        name = link.attachment.name
        limit, few = (FLOOD_BATCH, FLOOD_BATCH / 2) if name in self.flooded else (self._batch, FLOOD_DATAGRAMS)
        began, before = self._loop.time(), self._unauthenticated()
        count = self._read(link, limit)
        unauthenticated = self._unauthenticated() - before
        if unauthenticated < few or 2 * unauthenticated <= count:
            self.flooded.discard(name)
            return
        self.flooded.add(name)
        now = self._loop.time()
        self._loop.remove_reader(link.strangers_fileno())
        pause_s = min(max(MIN_PAUSE_S, PAUSE * (now - began)), MAX_PAUSE_S)
        self._pauses[name] = self._loop.call_at(now + pause_s, self._resume, link)
        if now - self._logged_at >= LOG_INTERVAL_S:
            self._logged_at = now
            log.warning("flood link=%s unauthenticated=%d", name, self._unauthenticated())

    def _resume(self, link: UdpLink) -> None:
        del self._pauses[link.attachment.name]
        self.watch(link)
