"""Find duplicates and overlaps in one pass, so that rules stay (nearly) linear in the size of the fleet."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from typing import TypeVar

from meshctl.model.ip import IpNetwork

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


def group_by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """The values of every key; keys and values keep their order."""
    groups: dict[K, list[V]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups


def duplicates(pairs: Iterable[tuple[K, V]]) -> Iterator[tuple[K, list[V]]]:
    """The keys that occur more than once, with their values."""
    return ((key, values) for key, values in group_by_key(pairs).items() if len(values) > 1)


def overlaps(networks: Iterable[tuple[V, IpNetwork]]) -> Iterator[tuple[tuple[V, IpNetwork], tuple[V, IpNetwork]]]:
    """The networks that overlap one before them, by family, first address and width; each with that one.

    So sorted, a network overlaps either the widest network before it or none.
    """
    widest: tuple[V, IpNetwork] | None = None
    for entry in sorted(networks, key=lambda entry: (*_first(entry[1]), entry[1].prefixlen)):
        if widest is not None and entry[1].overlaps(widest[1]):
            yield entry, widest
        if widest is None or _last(entry[1]) > _last(widest[1]):
            widest = entry


def _first(network: IpNetwork) -> tuple[int, int]:
    return network.version, int(network.network_address)


def _last(network: IpNetwork) -> tuple[int, int]:
    return network.version, int(network.broadcast_address)
