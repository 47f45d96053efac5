"""Connections that rospy has lost, found by comparing them with the master's list.

The master reports a topic's publishers only when they change, and rospy ignores that report while it still holds the
connection to the previous publisher of the same node. It holds it until the subscriber's callback returns: a
subscriber that is busy while a publisher changes its type is never connected to the new one. Registering once more
makes the master repeat its report.
"""

from __future__ import annotations

from typing import Iterable, Mapping, NamedTuple

MAX_TRIES = 30
"""How often in a row a name is registered once more: a node that was killed stays in the master's list."""


class SystemState(NamedTuple):
    """The nodes that publish and that subscribe to each name, without this node, according to the master."""

    publishers: dict[str, list[str]]
    subscribers: dict[str, list[str]]


class LostConnections:
    """Chooses the names to register again. One for publishers, one for subscribers."""

    def __init__(self) -> None:
        # by name: how many connections are missing, and in how many checks in a row
        self._checks: dict[str, tuple[int, int]] = {}

    def due(self, connected: Mapping[str, int], listed: Mapping[str, Iterable[str]]) -> list[str]:
        """Names that had fewer connections than listed nodes at the last check, too, unless MAX_TRIES did not help."""
        missing = {name: len(list(listed.get(name, ()))) - count for name, count in connected.items()}
        found = {}
        for name, count in missing.items():
            if count > 0:
                last_count, checks = self._checks.get(name, (count, 0))
                found[name] = (count, checks + 1 if last_count == count else 1)
        self._checks = found
        return [name for name, (_, checks) in found.items() if 1 < checks <= MAX_TRIES + 1]
