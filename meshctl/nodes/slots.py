"""How many connections to nodes work at once: a limit per mesh and one for the bench, which follow what they carry.

A slot is held while a login, a transfer or an observation uses the channel and this machine, never while a node is only
waited for (`ChannelSlots.acquire`). Each limit starts low, grows with every login that is as fast as usual, and shrinks
when logins become slow: a mesh whose airtime is used up, and a machine whose processor is, both show in them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

# The node's group before it is known where it is.
UNKNOWN = ""
# Per group: how many slots there are at first, and at most. All nodes of a mesh share its channel; cables do not.
MESH_SLOTS, BENCH_SLOTS = (8, 32), (32, 256)
# A login this many times slower than the fastest one, and slower by this much, is slow. Far nodes of a mesh need
# several times as long as near ones.
SLOW_FACTOR, SLOW_S = 6.0, 3.0
SHRINK = 0.75
# Nodes in work at once, waiting included: each has two threads.
MAX_NODES_IN_WORK = 512
# Bundles, backups and commands of the operator's, which may be large.
MAX_TRANSFERS = 8


@dataclass(slots=True)
class AdaptiveLimit:
    """The number of slots of one group. Pure: grows by one with each usual login, shrinks with a slow one, but only
    once until as many logins as it has slots have ended, because all of them were under way together."""

    first: int
    most: int
    fastest_s: float = float("inf")
    _slots: float = field(init=False)
    # how many logins were under way at the latest shrinking and have not ended
    _under_way: int = field(init=False, default=0)

    def __post_init__(self) -> None:
        self._slots = float(self.first)

    @property
    def slots(self) -> int:
        return int(self._slots)

    def login_ended(self, took_s: float) -> None:
        self.fastest_s = min(self.fastest_s, took_s)
        if took_s <= max(SLOW_FACTOR * self.fastest_s, self.fastest_s + SLOW_S):
            self._slots = min(self.most, self._slots + 1)
        elif not self._under_way:
            self._under_way = self.slots
            self._slots = max(1.0, self.first / 2, self._slots * SHRINK)
        self._under_way = max(0, self._under_way - 1)


@dataclass(slots=True)
class _Group:
    limit: AdaptiveLimit
    in_use: int = 0


class Slot:
    """A slot that is held; `release` may be called twice, and from any thread."""

    def __init__(self, slots: ChannelSlots, group: str) -> None:
        self._slots = slots
        self._group: str | None = group

    def release(self) -> None:
        with self._slots.condition:
            group, self._group = self._group, None
            if group is not None:
                self._slots.give_back(group)


class ChannelSlots:
    """The slots of all groups. Thread-safe."""

    def __init__(self) -> None:
        self.condition = threading.Condition()
        self._groups: dict[str, _Group] = {}
        self._mesh_of: dict[str, str] = {}

    def assign(self, node: str, mesh: str) -> None:
        """`node` is reached through `mesh` from now on; empty: by a cable."""
        with self.condition:
            self._mesh_of[node] = mesh

    def acquire(self, node: str) -> Slot:
        """Wait for a slot of the node's group."""
        with self.condition:
            name = self._mesh_of.get(node, UNKNOWN)
            group = self._group(name)
            self.condition.wait_for(lambda: group.in_use < group.limit.slots)
            group.in_use += 1
            return Slot(self, name)

    @contextmanager
    def use(self, node: str) -> Iterator[Slot]:
        """Hold a slot within this block, or until it is released."""
        slot = self.acquire(node)
        try:
            yield slot
        finally:
            slot.release()

    def login_ended(self, node: str, took_s: float) -> None:
        """A login at `node` took so long."""
        with self.condition:
            self._group(self._mesh_of.get(node, UNKNOWN)).limit.login_ended(took_s)
            self.condition.notify_all()

    def give_back(self, group: str) -> None:
        """For `Slot`, with the condition held."""
        self._groups[group].in_use -= 1
        self.condition.notify_all()

    def _group(self, name: str) -> _Group:
        if name not in self._groups:
            self._groups[name] = _Group(AdaptiveLimit(*(MESH_SLOTS if name else BENCH_SLOTS)))
        return self._groups[name]


def nodes_in_work(parallel: int | None) -> int:
    """How many nodes may be in work at once: `apply.parallel`, where the inventory sets it."""
    return parallel if parallel is not None else MAX_NODES_IN_WORK


def transfers_at_once(parallel: int | None) -> int:
    """How many bulk transfers may be under way at once: `apply.parallel`, where the inventory sets it."""
    return parallel if parallel is not None else MAX_TRANSFERS
