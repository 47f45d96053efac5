"""Restores the items that the store held at the start, topic by topic: a topic may become a log at run time."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import replace

from udp_mesh.core.logs.item import LogKey
from udp_mesh.core.logs.knowledge import LogState, as_set
from udp_mesh.core.logs.retention import HeldItem, Shelf
from udp_mesh.core.logs.store import ItemUse, LogContents


class Restorer:
    """Keeps what the store held of topics that are not logs: without it, such a topic would use its numbers again."""

    def __init__(self, contents: LogContents, now: float) -> None:
        self._contents = contents
        self._loaded_at = now

    def restore(
        self, topics: Container[str], log: Callable[[LogKey], LogState | None], shelves: Mapping[str, Shelf]
    ) -> None:
        """Fill the logs and shelves of these topics, once each. `log` returns a log's state (None: too many logs)."""
        remembered, items = [], []
        for entry in self._contents.remembered:
            if entry.log.topic not in topics:
                remembered.append(entry)
            elif (state := log(entry.log)) is not None:
                state.received, state.carried = as_set(entry.received), as_set(entry.carried)
        for stored in self._contents.items:
            key, number = stored.id
            if key.topic not in topics:
                items.append(stored)
            elif (state := log(key)) is not None:
                state.held.add(number)
                state.received.add(number)
                if stored.use is ItemUse.CARRIED:
                    state.carried.add(number)
                else:
                    state.carried.remove(number)
                held = HeldItem(stored.size_bytes, self._loaded_at - stored.age_s, stored.use)
                shelves[key.topic].add(stored.id, held)
        self._contents = replace(self._contents, items=tuple(items), remembered=tuple(remembered))
