"""Sends datagrams over the links; those that a full socket does not take wait in a short queue.

A full socket never blocks the other links. Datagrams that the kernel refuses are counted and logged (`send_errors`).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence

from udp_mesh.core.interfaces import Datagram
from udp_mesh.core.settings import LinkInfo, LinkKind
from udp_mesh.daemon.send_errors import REVIEW_S, SendErrors
from udp_mesh.links.hub import LinkHub
from udp_mesh.links.udp import UdpLink

log = logging.getLogger(__name__)

MAX_BLOCKED_DATAGRAMS = 256
"""Datagrams queued for one full socket; more are dropped."""


class LinkOutput:
    """`on_unblocked` is called when a socket that was full has sent its queue."""

    def __init__(self, loop: asyncio.AbstractEventLoop, hub: LinkHub, on_unblocked: Callable[[], None]) -> None:
        self._loop = loop
        self._hub = hub
        self._on_unblocked = on_unblocked
        self._blocked: dict[str, list[Datagram]] = {}
        self._review_timer: asyncio.TimerHandle | None = None
        self._closed = False
        self.others: dict[str, Callable[[str, Sequence[Datagram]], None]] = {}
        """What sends over links that have no socket, by link."""
        self.send_errors = SendErrors()
        self.lost_on_full_socket = 0

    def close(self) -> None:
        self._closed = True
        if self._review_timer is not None:
            self._review_timer.cancel()

    def watch(self, link: UdpLink) -> None:
        """Continue with what waits for the link's socket."""
        if self._blocked.get(link.attachment.name):
            self._loop.add_writer(link.fileno(), self._writable, link)

    def link_closed(self, name: str) -> None:
        self._blocked.pop(name, None)
        self.send_errors.link_closed(name)

    def waiting(self, name: str) -> int:
        """How many datagrams wait for the link's socket."""
        return len(self._blocked.get(name, ()))

    def transmit_all(self, datagrams: list[Datagram]) -> None:
        """Send each over its link; consecutive ones of one link together."""
        start = 0
        while start < len(datagrams):
            name = datagrams[start].link
            end = start + 1
            while end < len(datagrams) and datagrams[end].link == name:
                end += 1
            self.transmit(name, datagrams[start:end] if end - start < len(datagrams) else datagrams)
            start = end

    def transmit(self, name: str, datagrams: list[Datagram]) -> None:
        """Send over the link, if it is open."""
        if name in self.others:
            self.others[name](name, datagrams)
            return
        link = self._hub.links.get(name)
        if link is None:
            return
        waiting = self._blocked.get(name, [])
        done = 0 if waiting else self._send(link, datagrams)
        if done == len(datagrams):
            return
        if not waiting:
            self._loop.add_writer(link.fileno(), self._writable, link)
        # Urgent datagrams first; beyond the limit, the latest of the others are dropped.
        waiting = sorted([*waiting, *datagrams[done:]], key=lambda datagram: not datagram.urgent)
        self._blocked[name] = waiting[:MAX_BLOCKED_DATAGRAMS]
        self.lost_on_full_socket += len(waiting[MAX_BLOCKED_DATAGRAMS:])

    def _writable(self, link: UdpLink) -> None:
        waiting = self._blocked.get(link.attachment.name, [])
        del waiting[: self._send(link, waiting)]
        if not waiting:
            self._loop.remove_writer(link.fileno())
            self._on_unblocked()

    def _send(self, link: UdpLink, datagrams: Sequence[Datagram]) -> int:
        """Sends from the front and returns how many are done, those refused by the kernel included."""
        done = link.send(datagrams)
        if link.send_errors:
            self.send_errors.add(link.attachment.name, link.send_errors, self._loop.time())
            link.send_errors.clear()
            if self._review_timer is None and not self._closed:
                self._review_timer = self._loop.call_later(REVIEW_S, self._log_send_errors)
        return done

    def _log_send_errors(self) -> None:
        going_on, over = self.send_errors.review(self._loop.time())
        for link in going_on:
            log.warning(
                "send-refused link=%s to=%s datagrams=%d reason=%s", link.link, link.to, link.datagrams, link.reason
            )
        for link in over:
            log.info("send-refused-no-more link=%s datagrams=%d reason=%s", link.link, link.datagrams, link.reason)
        self._review_timer = self._loop.call_later(REVIEW_S, self._log_send_errors) if self.send_errors else None


def link_info(link: UdpLink) -> LinkInfo:
    """An open link as the core knows it."""
    attachment = link.attachment
    return LinkInfo(
        name=attachment.name,
        kind=LinkKind.NEIGHBOURS if attachment.broadcast is None else LinkKind.BROADCAST,
        address=attachment.address,
        broadcast=attachment.broadcast,
        mtu=attachment.mtu,
    )
