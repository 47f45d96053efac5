"""What the kernel refuses to send -> what the operator is told: soon, then once a minute, and when it is over. Pure.

`SendErrors.add` takes what a link counted, `review` says what is to be told now, `active` is what the status shows. One
refusal stands for one link and one reason, however many peers it concerns: a firewall's rule, a route that forbids, an
interface that is gone.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import islice

from udp_mesh.daemon.status import show_address
from udp_mesh.links.attachments import Address

REVIEW_S = 1.0
"""Between reviews while anything is refused, and before it is told: an interface that goes down refuses, too, for the
moment until that is known."""
LOG_AGAIN_S = 60.0
"""A rule that stays must not fill the log."""
LOG_NEW_DESTINATIONS_S = 5.0
"""It concerns more peers than were told: sooner than that, but not a line for each."""
RESOLVED_AFTER_S = 15.0
"""So long without a refusal, and it is over: longer than from one sparse heartbeat to the next."""
MAX_DESTINATIONS = 64
"""Remembered of one refusal: a team's worth, whatever addresses a stranger claims."""

MAX_SHOWN_DESTINATIONS = 4
"""Destinations named in one line of the log."""


@dataclass(slots=True)
class SendError:
    """Datagrams that the kernel would not send on one link, for one reason, from `since` to `last` and perhaps on."""

    link: str
    reason: str
    since: float
    last: float
    datagrams: int = 0
    destinations: dict[Address, None] = field(default_factory=dict)
    logged_at: float | None = None
    logged_destinations: int = 0
    """Destinations it had when it was told last."""

    @property
    def to(self) -> str:
        """To whom: the first few, and how many more."""
        more = len(self.destinations) - MAX_SHOWN_DESTINATIONS
        shown = [str(show_address(destination)) for destination in islice(self.destinations, MAX_SHOWN_DESTINATIONS)]
        return ",".join(shown) + (f",and-{more}-more" if more > 0 else "")


class SendErrors:
    """What is being refused now."""

    def __init__(self) -> None:
        self._by_link_and_errno: dict[tuple[str, int], SendError] = {}

    def __bool__(self) -> bool:
        return bool(self._by_link_and_errno)

    def add(self, link: str, counts: Mapping[tuple[Address, int], int], now: float) -> None:
        """Counts what a link was refused: (destination, errno) -> datagrams."""
        for (destination, number), datagrams in counts.items():
            error = self._by_link_and_errno.get((link, number))
            if error is None:
                error = self._by_link_and_errno[link, number] = SendError(link, os.strerror(number), now, now)
            error.datagrams += datagrams
            error.last = now
            if len(error.destinations) < MAX_DESTINATIONS:
                error.destinations[destination] = None

    def link_closed(self, link: str) -> None:
        """Its last refusals were because of that, if they were not told before."""
        for key, error in list(self._by_link_and_errno.items()):
            if error.link == link and error.logged_at is None:
                del self._by_link_and_errno[key]

    def review(self, now: float) -> tuple[list[SendError], list[SendError]]:
        """What is to be told now: refusals that go on, and those that are over (forgotten with this)."""
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
        """Those told and not over."""
        return tuple(error for error in self._by_link_and_errno.values() if error.logged_at is not None)
