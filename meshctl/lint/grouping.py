"""Find duplicates in one pass, so that rules stay linear in the size of the fleet."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")

_MAX_SHOWN = 4


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """The values of every key; keys and values keep their order."""
    groups: dict[K, list[V]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def duplicates(pairs: Iterable[tuple[K, V]]) -> Iterator[tuple[K, list[V]]]:
    """The keys that occur more than once, with their values."""
    return ((key, values) for key, values in group_by_key(pairs).items() if len(values) > 1)


def join_limited(names: Sequence[str]) -> str:
    """`a, b, c, d and 3 more`."""
    shown = ", ".join(names[:_MAX_SHOWN])
    return shown if len(names) <= _MAX_SHOWN else f"{shown} and {len(names) - _MAX_SHOWN} more"
