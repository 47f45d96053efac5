"""Where nodes of tests keep messages."""

from __future__ import annotations

from udp_mesh.core.interfaces import StoredMessage


class Disk:
    """A store in memory that outlives nodes."""

    def __init__(self) -> None:
        self.kept: dict[int, StoredMessage] = {}

    def put(self, message: StoredMessage) -> bool:
        self.kept[message.key] = message
        return True

    def holds(self, key: int) -> bool:
        return key in self.kept

    def remove(self, key: int) -> None:
        self.kept.pop(key, None)

    def load(self) -> list[StoredMessage]:
        return [self.kept[key] for key in sorted(self.kept)]
