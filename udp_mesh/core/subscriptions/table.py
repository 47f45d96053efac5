"""Subscriptions of one peer's programs, as the peer announced them."""

from __future__ import annotations

import fnmatch
import re
from collections.abc import Iterable

from udp_mesh.core.subscriptions.messages import UNBOUNDED, Bounds, Subscription, SubscriptionTable

MAX_REMEMBERED = 1024
"""Topics of which the answer is remembered: a program here may invent names without bound."""


class KnownTable:
    """`confirmed_at` is when it last came."""

    __slots__ = ("_answers", "_exact", "_matchers", "confirmed_at", "table")

    def __init__(self, table: SubscriptionTable, now: float) -> None:
        self.table = table
        self.confirmed_at = now
        self._answers: dict[str, Bounds | None] = {}
        self._exact = united(entry for entry in table.subscriptions if not entry.has_wildcard)
        self._matchers: list[tuple[re.Pattern[str], Bounds]] | None = None

    def bounds(self, topic: str) -> Bounds | None:
        """The bounds that the peer's programs want for a topic; None: they do not read it."""
        if self.table.everything:
            return UNBOUNDED
        try:
            return self._answers[topic]
        except KeyError:
            answer = self._look_up(topic)
        if len(self._answers) >= MAX_REMEMBERED:
            self._answers.clear()
        self._answers[topic] = answer
        return answer

    def _look_up(self, topic: str) -> Bounds | None:
        if self._matchers is None:
            # Not before a topic is sent: a member could send tables in a stream.
            self._matchers = [
                (re.compile(fnmatch.translate(entry.pattern)), entry.bounds)
                for entry in self.table.subscriptions
                if entry.has_wildcard
            ]
        found = self._exact.get(topic)
        for matcher, bounds in self._matchers:
            if matcher.match(topic):
                found = bounds if found is None else found.united(bounds)
        return found


def united(subscriptions: Iterable[Subscription]) -> dict[str, Bounds]:
    """By pattern, what satisfies every reader."""
    found: dict[str, Bounds] = {}
    for pattern, bounds in subscriptions:
        found[pattern] = found[pattern].united(bounds) if pattern in found else bounds
    return found
