"""A snapshot of each log, for the status page, the autonomy and the metrics."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from udp_mesh.core.logs.knowledge import LogState, PeerView, as_set
from udp_mesh.core.logs.retention import Shelf


@dataclass(frozen=True, slots=True)
class LogHolder:
    """A node that has items of a log: a reader (even if it dropped them since), or an online peer that carries them."""

    name: str
    reader: bool
    items: int
    newest: int
    """The highest number it has; 0 if none."""


@dataclass(frozen=True, slots=True)
class LogConditions:
    """One log as this node sees it."""

    topic: str
    source: str
    log_id: bytes
    held_items: int
    held_bytes: int
    received_items: int
    """Items that this node has or had."""
    newest: int
    """The highest number it has had; 0 if none."""
    known_items: int
    """Items that exist, as far as this node has heard."""
    waiting_items: int
    """Items that no local program has taken yet."""
    missing_readers: tuple[tuple[str, int], ...]
    """For each named reader that is not known to have everything this node has had: how many items it lacks."""
    holders: tuple[LogHolder, ...]


def conditions_of(
    logs: Iterable[LogState],
    peers: Mapping[str, PeerView],
    shelves: Mapping[str, Shelf],
    readers: Mapping[str, tuple[str, ...]],
) -> tuple[LogConditions, ...]:
    """The snapshot, ordered by topic and source."""
    sizes: dict[object, tuple[int, int]] = {}
    for shelf in shelves.values():
        for item, held in shelf.items.items():
            size, waiting = sizes.get(item.log, (0, 0))
            sizes[item.log] = (size + held.size_bytes, waiting + held.waits)
    rows = []
    for state in sorted(logs, key=lambda log: log.key):
        key = state.key
        everything = as_set(state.received.ranges())
        for view in peers.values():
            for first, last in view.held[key].ranges() if key in view.held else ():
                everything.add_range(first, last)
        names = readers.get(key.topic, ())
        lacking = ((name, as_set(state.received.without(state.readers.get(name) or as_set(())))) for name in names)
        held_bytes, waiting = sizes.get(key, (0, 0))
        rows.append(
            LogConditions(
                key.topic,
                key.source,
                key.log_id,
                state.held.count,
                held_bytes,
                state.received.count,
                _newest(state.received.ranges()),
                everything.count,
                waiting,
                tuple((name, missing.count) for name, missing in lacking if missing.count),
                _holders(state, peers, names),
            )
        )
    return tuple(rows)


def _holders(state: LogState, peers: Mapping[str, PeerView], names: tuple[str, ...]) -> tuple[LogHolder, ...]:
    readers = [
        LogHolder(name, True, have.count, _newest(have.ranges())) for name, have in sorted(state.readers.items())
    ]
    carriers = [
        LogHolder(name, False, view.held[state.key].count, _newest(view.held[state.key].ranges()))
        for name, view in sorted(peers.items())
        if state.key in view.held and view.held[state.key].count and name not in state.readers and name not in names
    ]
    return (*readers, *carriers)


def _newest(ranges: list[tuple[int, int]]) -> int:
    return ranges[-1][1] if ranges else 0
