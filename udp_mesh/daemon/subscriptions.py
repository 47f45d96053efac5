"""Which clients get the messages of a topic."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator

from udp_mesh.client.mesh_client import Header, encode_frame
from udp_mesh.daemon.api import Client, RequestError

MAX_ROUTES = 4096
"""Topics whose clients are remembered; a holder of the key could invent names without bound."""
MAX_PATTERNS = 1024
"""Patterns per client: each is matched against each new topic."""


class Subscriptions:
    """Patterns of topic names by client, and the clients of each topic that was seen."""

    def __init__(self) -> None:
        self._patterns: dict[Client, list[str]] = {}
        self._routes: dict[str, list[Client]] = {}

    def add(self, client: Client, patterns: list[str]) -> None:
        wanted = self._patterns.setdefault(client, [])
        # A client may subscribe to the same pattern repeatedly; store it once.
        new = [pattern for pattern in dict.fromkeys(patterns) if pattern not in wanted]
        if len(wanted) + len(new) > MAX_PATTERNS:
            raise RequestError("too-many", f"a client may subscribe to at most {MAX_PATTERNS} patterns")
        wanted.extend(new)
        self._routes.clear()

    def remove(self, client: Client, patterns: list[str]) -> None:
        kept = [pattern for pattern in self._patterns.get(client, ()) if pattern not in patterns]
        self._patterns[client] = kept
        self._routes.clear()

    def remove_client(self, client: Client) -> None:
        self._patterns.pop(client, None)
        self._routes.clear()

    def subscribed_literally(self, topic: str) -> Iterator[Client]:
        """The clients that named this topic itself: a pattern such as `*` does not match a reserved one."""
        return (client for client, patterns in self._patterns.items() if topic in patterns)

    def distribute(self, header: Header, payload: bytes) -> None:
        """Send a message to every client with a matching pattern."""
        topic = str(header["topic"])
        clients = self._routes.get(topic)
        if clients is None:
            clients = [
                client
                for client, patterns in self._patterns.items()
                if any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)
            ]
            if len(self._routes) >= MAX_ROUTES:
                self._routes.clear()
            self._routes[topic] = clients
        if clients:
            frame = encode_frame(header, payload)
            for client in clients:
                client.send_encoded(frame)
