"""What the kernel refuses to send -> what the operator is told: soon, then once a minute, and when it is over. Pure.

`Refusals.add` takes what a link counted, `review` says what is to be told now, `standing` is what the status shows. One
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
TELL_AGAIN_S = 60.0
"""A rule that stays must not fill the log."""
TELL_MORE_S = 5.0
"""It concerns more peers than were told: sooner than that, but not a line for each."""
OVER_S = 15.0
"""So long without a refusal, and it is over: longer than from one sparse heartbeat to the next."""
DESTINATIONS = 64
"""Remembered of one refusal: a team's worth, whatever addresses a stranger claims."""

SHOWN = 4
"""Destinations named in one line of the log."""


@dataclass(slots=True)
class Refusal:
    """Datagrams that the kernel would not send on one link, for one reason, from `since` to `last` and perhaps on."""

    link: str
    reason: str
    since: float
    last: float
    datagrams: int = 0
    destinations: dict[Address, None] = field(default_factory=dict)
    told_at: float | None = None
    told_of: int = 0
    """Destinations it had when it was told last."""

    @property
    def to(self) -> str:
        """To whom: the first few, and how many more."""
        more = len(self.destinations) - SHOWN
        shown = [str(show_address(destination)) for destination in islice(self.destinations, SHOWN)]
        return ",".join(shown) + (f",and-{more}-more" if more > 0 else "")


class Refusals:
    """What is being refused now."""

    def __init__(self) -> None:
        self._standing: dict[tuple[str, int], Refusal] = {}

    def __bool__(self) -> bool:
        return bool(self._standing)

    def add(self, link: str, refused: Mapping[tuple[Address, int], int], now: float) -> None:
        """Counts what a link was refused: (destination, errno) -> datagrams."""
        for (destination, number), datagrams in refused.items():
            refusal = self._standing.get((link, number))
            if refusal is None:
                refusal = self._standing[link, number] = Refusal(link, os.strerror(number), now, now)
            refusal.datagrams += datagrams
            refusal.last = now
            if len(refusal.destinations) < DESTINATIONS:
                refusal.destinations[destination] = None

    def link_gone(self, link: str) -> None:
        """Its last refusals were because of that, if they were not told before."""
        for key, refusal in list(self._standing.items()):
            if refusal.link == link and refusal.told_at is None:
                del self._standing[key]

    def review(self, now: float) -> tuple[list[Refusal], list[Refusal]]:
        """What is to be told now: refusals that go on, and those that are over (forgotten with this)."""
        going_on, over = [], []
        for key, refusal in list(self._standing.items()):
            if now - refusal.last >= OVER_S:
                del self._standing[key]
                over.append(refusal)
            elif refusal.told_at is None or now - refusal.told_at >= (
                TELL_MORE_S if len(refusal.destinations) > refusal.told_of else TELL_AGAIN_S
            ):
                refusal.told_at, refusal.told_of = now, len(refusal.destinations)
                going_on.append(refusal)
        return going_on, over

    def standing(self) -> tuple[Refusal, ...]:
        """Those told and not over."""
        return tuple(refusal for refusal in self._standing.values() if refusal.told_at is not None)
