"""Policy of each log at this node, from the settings: its readers, its carriers, and its limits."""

from __future__ import annotations

from collections.abc import Mapping

from udp_mesh.core.logs.knowledge import PeerView
from udp_mesh.core.logs.retention import Shelf
from udp_mesh.core.settings import Log, Topic


class Policy:
    """`shelves` and `peers` are those of the `Replicator`, as they change."""

    def __init__(self, name: str, shelves: Mapping[str, Shelf], peers: Mapping[str, PeerView]) -> None:
        self.name = name
        self.topics: dict[str, Topic] = {}
        self._shelves = shelves
        self._peers = peers

    def _log(self, topic: str) -> Log | None:
        settings = self.topics.get(topic)
        return None if settings is None else settings.log

    def readers(self, topic: str) -> tuple[str, ...]:
        """The named readers of a log (empty: all nodes with the topic)."""
        log = self._log(topic)
        return () if log is None else log.readers

    def is_reader(self, topic: str) -> bool:
        """Whether programs here get the items."""
        readers = self.readers(topic)
        return not readers or self.name in readers

    def reader_online(self, topic: str, excluding: str = "") -> bool:
        """Whether a named reader, other than this node and `excluding`, is in reach."""
        others = (name for name in self.readers(topic) if name not in (self.name, excluding))
        return any(name in self._peers and not self._peers[name].silent for name in others)

    def copies(self, topic: str) -> int:
        """How many nodes in reach of each other carry an item, besides its source and readers."""
        log = self._log(topic)
        return 0 if log is None else log.copies

    def room(self, topic: str, limit: int) -> int:
        """How many more items of the topic this node takes, at most `limit`."""
        reads = self.is_reader(topic)
        if topic not in self.topics or (not reads and not self.copies(topic)):
            return 0
        return self._shelves[topic].room(limit, wanted=reads)
