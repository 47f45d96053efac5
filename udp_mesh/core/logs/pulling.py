"""Choose the items to request now, and from which peer: the missing ones of every log, each from one peer at a time.

A reader requests what it lacks at once. A node that only carries never requests what all readers have, nor what enough
others in reach carry already. It requests nothing over a weak link for a while: the same items cost a fraction of the
airtime once the robots are closer. It leaves items to their readers for a while if one of them is in reach of the
holder or of this node, and to other carriers if it is not among the first in an order that all of them compute alike.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import blake2s

from udp_mesh.core.logs.item import ItemId, LogKey
from udp_mesh.core.logs.knowledge import LogState, PeerView, as_set
from udp_mesh.core.logs.messages import MAX_ENTRIES, ItemRequest
from udp_mesh.core.logs.policy import Policy
from udp_mesh.core.ranges import RangeSet

MAX_REQUESTED = 32
"""Items requested from one peer and not received yet: enough to keep a link busy across a round trip."""
REQUEST_TIMEOUT_S = 60.0
"""A peer that sends none of the requested items for this long, although online, is left alone as long again."""
CUSTODY_DELAY_S = 3.0
"""How long carriers leave items to readers in reach."""
DISK_PAUSE_S = 30.0
"""Nothing is requested for this long after the disk refused an item: a full disk stays full for a while."""
REFUSED_PAUSE_S = 60.0
"""An item that did not fit is requested again after this time."""
MAX_REFUSED = 1024
"""Items that did not fit and are remembered."""
FULL_PAUSE_S = 1.0
"""A full log is looked at again after this time: that takes a look at each of its items."""
_NEVER = float("inf")


@dataclass(slots=True)
class Requests:
    """Items requested and not received yet."""

    items: dict[ItemId, str] = field(default_factory=dict)
    """The peer that was asked for each."""
    counts: dict[str, int] = field(default_factory=dict)
    progress_at: dict[str, float] = field(default_factory=dict)
    """When each peer last sent a requested item, or was first asked for one."""

    def add(self, item: ItemId, peer: str, now: float) -> None:
        if not self.counts.get(peer):
            self.progress_at[peer] = now
        self.items[item] = peer
        self.counts[peer] = self.counts.get(peer, 0) + 1

    def received(self, item: ItemId, now: float) -> None:
        """The item came, from this or another peer."""
        peer = self.items.pop(item, None)
        if peer is not None:
            self.counts[peer] -= 1
            self.progress_at[peer] = now

    def forget(self, peer: str) -> None:
        """The peer is gone or does not answer."""
        self._remove(peer, [item for item, asked in self.items.items() if asked == peer])

    def keep_only(self, peer: str, log: LogKey, held: RangeSet) -> None:
        """The peer now holds these items of a log: what it dropped is requested from others."""
        gone = [
            item for item, asked in self.items.items() if asked == peer and item.log == log and item.number not in held
        ]
        self._remove(peer, gone)

    def remove(self, log: LogKey, numbers: RangeSet) -> None:
        """These items of a log are not needed any more."""
        needless = [item for item in self.items if item.log == log and item.number in numbers]
        for peer in {self.items[item] for item in needless}:
            self._remove(peer, [item for item in needless if self.items.get(item) == peer])

    def _remove(self, peer: str, items: list[ItemId]) -> None:
        for item in items:
            del self.items[item]
        self.counts[peer] = self.counts.get(peer, 0) - len(items)

    def late(self, now: float) -> list[str]:
        """The peers that have sent nothing requested for too long."""
        return [
            peer
            for peer, count in self.counts.items()
            if count > 0 and now - self.progress_at.get(peer, now) > REQUEST_TIMEOUT_S
        ]


class Pulling:
    """See the module's docstring."""

    def __init__(self) -> None:
        self.requests = Requests()
        self.next_at = _NEVER
        """When a delay ends, as of the last `plan`."""
        self._paused_until = float("-inf")
        self._avoided: dict[str, float] = {}
        self._full_until: dict[str, float] = {}
        self._refused: dict[ItemId, float] = {}

    def pause(self, now: float) -> None:
        """The disk refused an item."""
        self._paused_until = now + DISK_PAUSE_S

    def refuse(self, item: ItemId, now: float) -> None:
        """There was no room for the item: its size is known only once it is here."""
        self._refused[item] = now + REFUSED_PAUSE_S
        if len(self._refused) > MAX_REFUSED:
            del self._refused[next(iter(self._refused))]

    def not_sent(self, peer: str, now: float) -> None:
        """The transport's queue for the peer is full: it gets no requests for a while."""
        self.requests.forget(peer)
        self._avoided[peer] = now + FULL_PAUSE_S

    def plan(
        self,
        logs: Mapping[LogKey, LogState],
        peers: Mapping[str, PeerView],
        policy: Policy,
        now: float,
    ) -> list[tuple[str, ItemRequest]]:
        """The requests to send now, which then count as open."""
        for peer in self.requests.late(now):
            self.requests.forget(peer)
            self._avoided[peer] = now + REQUEST_TIMEOUT_S
        self.next_at = self._paused_until if self._paused_until > now else _NEVER
        if self._paused_until > now or not peers:
            return []
        wanted: dict[str, dict[LogKey, RangeSet]] = {}
        skips, rooms = self._requested(now), dict[str, int]()
        for key, state in logs.items():
            if key.topic not in rooms:
                open_requests = sum(1 for item in self.requests.items if item.log.topic == key.topic)
                limit = MAX_REQUESTED * len(peers)
                is_full = self._full_until.get(key.topic, now) > now
                rooms[key.topic] = 0 if is_full else policy.room(key.topic, limit + open_requests) - open_requests
                if rooms[key.topic] <= 0 and not is_full:
                    self._full_until[key.topic] = now + FULL_PAUSE_S
            if rooms[key.topic] <= 0:
                continue
            holders = [
                (peer, held)
                for peer, held in _holders(peers, key, self.requests.counts)
                if self.requests.counts.get(peer, 0) < MAX_REQUESTED and self._avoided.get(peer, now) <= now
            ]
            if not holders:
                continue
            skip = skips.get(key) or RangeSet()
            reads = policy.is_reader(key.topic)
            if not reads:
                holders = [(peer, held) for peer, held in holders if not peers[peer].is_weak(now)]
                skip = self._carried(state, peers, policy, skip)
            lacks = False
            for peer, held in holders:
                room = min(MAX_REQUESTED - self.requests.counts.get(peer, 0), rooms[key.topic])
                numbers = missing(state, held, skip, room) if room > 0 else []
                lacks = lacks or bool(numbers)
                if not numbers or (not reads and self._is_deferred(state, peers, peer, policy, now)):
                    continue
                rooms[key.topic] -= len(numbers)
                chosen = wanted.setdefault(peer, {}).setdefault(key, RangeSet())
                for number in numbers:
                    chosen.add(number)
                    skip.add_range(number, number)
                    self.requests.add(ItemId(key, number), peer, now)
            if not lacks:
                # The next items are again left to others for a while.
                state.deferred_until = None
        return [want for peer, entries in wanted.items() for want in _in_messages(peer, entries)]

    def _requested(self, now: float) -> dict[LogKey, RangeSet]:
        requested: dict[LogKey, RangeSet] = {}
        for item in (*self.requests.items, *self._refused):
            if self._refused.get(item, now + 1) > now:
                requested.setdefault(item.log, RangeSet()).add_range(item.number, item.number)
        return requested

    def _carried(
        self,
        state: LogState,
        peers: Mapping[str, PeerView],
        policy: Policy,
        skip: RangeSet,
    ) -> RangeSet:
        """`skip`, with what a node that only carries leaves alone."""
        key, topic = state.key, state.key.topic
        read = state.read_by_all(policy.readers(topic))
        carriers = [
            view.held[key]
            for peer, view in peers.items()
            if peer != key.source and key in view.held and not view.silent
        ]
        enough = in_at_least(policy.copies(topic), carriers)
        return as_set([*skip.ranges(), *read.ranges(), *enough.ranges()])

    def _is_deferred(
        self,
        state: LogState,
        peers: Mapping[str, PeerView],
        peer: str,
        policy: Policy,
        now: float,
    ) -> bool:
        """Whether to leave the items to readers in reach or to other carriers, for a while."""
        key = state.key
        reader_in_reach = key in peers[peer].reader_online or policy.reader_online(key.topic, excluding=peer)
        if not reader_in_reach and rank(policy.name, key, peers) < policy.copies(key.topic):
            return False
        if state.deferred_until is None:
            state.deferred_until = now + CUSTODY_DELAY_S
        if state.deferred_until > now:
            self.next_at = min(self.next_at, state.deferred_until)
        return state.deferred_until > now


def rank(name: str, log: LogKey, peers: Iterable[str]) -> int:
    """How many of the peers come before this node in the order in which nodes take custody of a log's items. Each log
    has an order of its own, so that the same nodes do not carry everything."""

    def place(node: str) -> bytes:
        return blake2s(node.encode(), key=log.log_id).digest()

    own = place(name)
    return sum(1 for peer in peers if peer != log.source and place(peer) < own)


def in_at_least(count: int, sets: list[RangeSet]) -> RangeSet:
    """The numbers that at least `count` of the sets contain."""
    edges: list[tuple[int, int]] = []
    for held in sets:
        for first, last in held.ranges():
            edges += [(first, 1), (last + 1, -1)]
    result, depth, begin = RangeSet(), 0, 0
    for at, change in sorted(edges):
        if depth < count <= depth + change:
            begin = at
        elif depth + change < count <= depth:
            result.add_range(begin, at - 1)
        depth += change
    return result


def missing(state: LogState, held: RangeSet, skip: RangeSet, limit: int) -> list[int]:
    """The first numbers in `held` that this node never had, except those in `skip`; at most `limit`."""
    numbers: list[int] = []
    for first, last in as_set(as_set(held.without(state.received)).without(skip)).ranges():
        # A peer may claim any numbers: never iterate over more than can be chosen.
        for number in range(first, min(last, first + limit + len(state.storing)) + 1):
            if number not in state.storing:
                numbers.append(number)
                if len(numbers) == limit:
                    return numbers
    return numbers


def _holders(peers: Mapping[str, PeerView], log: LogKey, counts: Mapping[str, int]) -> Iterable[tuple[str, RangeSet]]:
    """The peers that hold something of a log: its source first, then those with the fewest open requests."""
    holders = [(name, view.held[log]) for name, view in peers.items() if log in view.held and not view.silent]
    return sorted(holders, key=lambda holder: (holder[0] != log.source, counts.get(holder[0], 0), holder[0]))


def _in_messages(peer: str, entries: dict[LogKey, RangeSet]) -> list[tuple[str, ItemRequest]]:
    logs = [(key, tuple(numbers.ranges())) for key, numbers in entries.items()]
    return [(peer, ItemRequest(tuple(logs[start : start + MAX_ENTRIES]))) for start in range(0, len(logs), MAX_ENTRIES)]
