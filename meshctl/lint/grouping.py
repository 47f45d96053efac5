"""Group equal things in one pass, so that a rule about collisions costs what the fleet's size costs."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

# more names than these say nothing more to a reader
_MAX_SHOWN = 4


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """The values of every key, both in the order of their coming."""
    groups: dict[K, list[V]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def duplicates(pairs: Iterable[tuple[K, V]]) -> Iterator[tuple[K, list[V]]]:
    """The keys that came more than once, with their values."""
    return ((key, values) for key, values in group_by_key(pairs).items() if len(values) > 1)


def join_limited(names: Sequence[str]) -> str:
    """`a, b, c`, cut after a few."""
    shown = ", ".join(names[:_MAX_SHOWN])
    return shown if len(names) <= _MAX_SHOWN else f"{shown} and {len(names) - _MAX_SHOWN} more"
