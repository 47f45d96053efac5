"""Send errors of the kernel -> log lines: soon after the first, then once a minute, and when they stop. Pure.

`SendErrors.add` takes a link's error counts, `review` returns what to log now, `active` what the status shows. One
entry covers one link and one errno, however many peers it affects: a firewall rule, a prohibiting route, a removed
interface.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice

from udp_mesh.daemon.status import show_address
from udp_mesh.links.attachments import Address

REVIEW_S = 1.0
"""Interval between reviews while there are errors, and delay before the first log line: an interface that goes down
causes errors until the kernel reports it."""
LOG_AGAIN_S = 60.0
"""Interval between log lines for an error that persists."""
LOG_NEW_DESTINATIONS_S = 5.0
"""The same if the error affects more peers than were logged: sooner, but not a line for each."""
RESOLVED_AFTER_S = 15.0
"""An error that did not occur for this long has ended: longer than the interval of sparse heartbeats."""
MAX_DESTINATIONS = 64
"""Destinations stored per error: a whole team, whatever addresses unverified peers claim."""

MAX_SHOWN_DESTINATIONS = 4
"""Destinations named in one log line."""


@dataclass(slots=True)
class SendError:
    """Datagrams that the kernel refused to send on one link with one errno, from `since` to `last`."""

    link: str
    reason: str
    since: float
    last: float
    datagrams: int = 0
    destinations: dict[Address, None] = field(default_factory=dict)
    logged_at: float | None = None
    logged_destinations: int = 0
    """Number of destinations when it was last logged."""

    @property
    def to(self) -> str:
        """The first few destinations and the number of further ones."""
        more = len(self.destinations) - MAX_SHOWN_DESTINATIONS
        shown = [str(show_address(destination)) for destination in islice(self.destinations, MAX_SHOWN_DESTINATIONS)]
        return ",".join(shown) + (f",and-{more}-more" if more > 0 else "")


class SendErrors:
    """The send errors that occur now."""

    def __init__(self) -> None:
        self._by_link_and_errno: dict[tuple[str, int], SendError] = {}

    def __bool__(self) -> bool:
        return bool(self._by_link_and_errno)

    def add(self, link: str, counts: Mapping[tuple[Address, int], int], now: float) -> None:
        """Adds a link's error counts: (destination, errno) -> datagrams."""
        for (destination, number), datagrams in counts.items():
            error = self._by_link_and_errno.get((link, number))
            if error is None:
                error = self._by_link_and_errno[link, number] = SendError(link, os.strerror(number), now, now)
            error.datagrams += datagrams
            error.last = now
            if len(error.destinations) < MAX_DESTINATIONS:
                error.destinations[destination] = None

    def link_closed(self, link: str) -> None:
        """Drops errors of a closed link that were not logged: its closing caused them."""
        for key, error in list(self._by_link_and_errno.items()):
            if error.link == link and error.logged_at is None:
                del self._by_link_and_errno[key]

    def review(self, now: float) -> tuple[list[SendError], list[SendError]]:
        """The errors to log now: those that persist, and those that ended (and are removed)."""
        ongoing, resolved = [], []
        for key, error in list(self._by_link_and_errno.items()):
            if now - error.last >= RESOLVED_AFTER_S:
                del self._by_link_and_errno[key]
                resolved.append(error)
            elif error.logged_at is None or now - error.logged_at >= (
                LOG_NEW_DESTINATIONS_S if len(error.destinations) > error.logged_destinations else LOG_AGAIN_S
            ):
                error.logged_at, error.logged_destinations = now, len(error.destinations)
                ongoing.append(error)
        return ongoing, resolved

    def active(self) -> tuple[SendError, ...]:
        """The errors that were logged and have not ended."""
        return tuple(error for error in self._by_link_and_errno.values() if error.logged_at is not None)
