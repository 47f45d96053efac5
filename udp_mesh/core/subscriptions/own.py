"""Subscriptions of this node's programs, and the peers that follow them.

A peer that asked gets the table, and a new one after each change. New subscriptions are announced at once, ended
ones after `LINGER_S`, since many programs come back. Nothing is announced in the first `STARTING_S`:
the programs of a restarted robot are still connecting, and until peers know the table they send everything.
"""

from __future__ import annotations

from collections.abc import Iterable

from udp_mesh.core.peers.session import Session
from udp_mesh.core.subscriptions.messages import MAX_ENTRIES, Bounds, Subscription, SubscriptionTable, encode_table
from udp_mesh.core.subscriptions.table import united

STARTING_S = 5.0
LINGER_S = 2.0
GATHER_S = 0.02
"""Changes within this time share one table: a program subscribes topic by topic."""
INTERVAL_S = 0.1
"""Minimum interval of tables: a program that subscribes and unsubscribes in a loop must not flood the channel."""
RETRY_S = 1.0
"""Minimum interval of the same table to one peer, which may ask in a loop; and until one that its queue had no room
for is sent again."""
_NEVER = float("inf")


class _Follower:
    """A peer that asked. `announced` is the generation it was sent last, at `announced_at`."""

    __slots__ = ("announced", "announced_at")

    def __init__(self) -> None:
        self.announced = 0
        self.announced_at = float("-inf")


class OwnSubscriptions:
    """`next_at` is when `due` is to be called next."""

    def __init__(self, now: float) -> None:
        self._answers_from = now + STARTING_S
        self._wanted: dict[str, Bounds] | None = None
        """None until programs' subscriptions are set: then everything is wanted."""
        self._leaving: dict[str, tuple[Bounds, float]] = {}
        """What is not read any more, and until when it is announced as read."""
        self._shown: tuple[Subscription, ...] | None = None
        self.generation = 1
        self._followers: dict[Session, _Follower] = {}
        self.next_at = _NEVER

    def set(self, subscriptions: Iterable[Subscription], now: float) -> None:
        """Replace what programs read."""
        before, self._wanted = self._wanted, united(subscriptions)
        for pattern in self._wanted:
            self._leaving.pop(pattern, None)
        for pattern, bounds in (before or {}).items():
            if pattern not in self._wanted:
                self._leaving[pattern] = (bounds, now + LINGER_S)
        while len(self._leaving) > MAX_ENTRIES:
            del self._leaving[next(iter(self._leaving))]
        self._refresh(now)

    def shown(self) -> tuple[Subscription, ...] | None:
        """The subscriptions announced to peers; None: everything."""
        return self._shown

    def table(self) -> bytes:
        """The encoded table of the current generation."""
        return encode_table(SubscriptionTable(self.generation, self._shown or (), everything=self._shown is None))

    def _refresh(self, now: float) -> None:
        """The next generation, if what is announced changed."""
        self._leaving = {pattern: entry for pattern, entry in self._leaving.items() if entry[1] > now}
        if self._wanted is None:
            return
        leaving = {pattern: bounds for pattern, (bounds, _) in self._leaving.items()}
        shown = tuple(Subscription(*entry) for entry in sorted({**leaving, **self._wanted}.items()))
        if shown != self._shown:
            self._shown = shown
            self.generation += 1
            self._schedule(now + GATHER_S)
        for _, until in self._leaving.values():
            self._schedule(until)

    def _schedule(self, at: float) -> None:
        self.next_at = min(self.next_at, max(at, self._answers_from))

    def on_ask(self, session: Session, limit: int, now: float) -> None:
        """A peer wants to know the table. At most `limit` are remembered: a key holder inventing names."""
        follower = self._followers.get(session)
        if follower is None:
            if len(self._followers) >= limit:
                self._purge()
            if len(self._followers) >= limit:
                return
            follower = self._followers[session] = _Follower()
        if follower.announced == self.generation:
            # It came back, or what it was sent is under way.
            follower.announced = 0
            self._schedule(follower.announced_at + RETRY_S)
        else:
            self._schedule(now)

    def _purge(self) -> None:
        """Forget boots that have been replaced."""
        self._followers = {session: follower for session, follower in self._followers.items() if session.is_current}

    def due(self, now: float) -> list[Session]:
        """The peers to send the table to now."""
        self.next_at = _NEVER
        self._refresh(now)
        if now < self._answers_from:
            self._schedule(now)
            return []
        found: list[Session] = []
        self._purge()
        for session, follower in self._followers.items():
            if follower.announced == self.generation:
                continue
            if session.peer is None or not session.peer.online:
                # It may never notice that it was offline here.
                self._schedule(now + RETRY_S)
            elif now < (at := follower.announced_at + (INTERVAL_S if follower.announced else RETRY_S)):
                self._schedule(at)
            else:
                found.append(session)
        return found

    def on_announced(self, session: Session, now: float, *, sent: bool) -> None:
        """The table went to this peer's queue, or (not `sent`) did not fit there."""
        follower = self._followers[session]
        follower.announced_at = now
        if sent:
            follower.announced = self.generation
        else:
            self._schedule(now + RETRY_S)
