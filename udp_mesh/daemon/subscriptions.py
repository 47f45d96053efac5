"""Which local programs receive which messages: live ones, and those that the inbox holds for them."""

from __future__ import annotations

import asyncio
import fnmatch
from collections.abc import Callable, Coroutine, Iterator

from udp_mesh.client.mesh_client import Header, encode_frame
from udp_mesh.core.events import MessageReceived
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.inbox import Inbox, LoggedItem

MAX_PATTERNS = 1024
"""Patterns per client: each is matched against each new topic."""
MAX_ROUTES = 4096
"""Topics whose subscribers are remembered; a holder of the key could invent names without bound."""
MAX_READS = 64
"""Items of logs requested for programs and not delivered yet."""
READ_TIMEOUT_S = 30.0
"""An item that the log did not deliver for this long, such as one that it dropped meanwhile, no longer counts."""


class Subscriptions:
    """`spawn` runs a task; `priority` is that of a topic."""

    def __init__(
        self,
        inbox: Inbox,
        spawn: Callable[[Coroutine[None, None, None]], None],
        priority: Callable[[str], int],
    ) -> None:
        self._inbox = inbox
        self._spawn = spawn
        self._priority = priority
        self._patterns: dict[Client, list[str]] = {}
        self._acknowledging: set[Client] = set()
        """Clients that acknowledge messages with receipts."""
        self._routes: dict[str, list[Client]] = {}
        self._passing_on = False
        self._full: set[Client] = set()
        """Clients that did not take a held message: they get no more until they have read what was sent to them."""
        self._reads: dict[LoggedItem, float] = {}
        """Items of logs being read for programs, with the time of the request."""

    def add(self, client: Client, patterns: list[str], *, acknowledge: bool) -> None:
        """Raises RequestError for too many patterns."""
        wanted = self._patterns.setdefault(client, [])
        # A client may subscribe to the same pattern repeatedly; store it once.
        new = [pattern for pattern in dict.fromkeys(patterns) if pattern not in wanted]
        if len(wanted) + len(new) > MAX_PATTERNS:
            raise RequestError("too-many", f"a client may subscribe to at most {MAX_PATTERNS} patterns")
        wanted.extend(new)
        if acknowledge:
            self._acknowledging.add(client)
        self._routes.clear()
        self.pass_on_held()

    def remove(self, client: Client, patterns: list[str]) -> None:
        kept = [pattern for pattern in self._patterns.get(client, ()) if pattern not in patterns]
        self._patterns[client] = kept
        self._routes.clear()

    def remove_client(self, client: Client) -> None:
        self._patterns.pop(client, None)
        self._acknowledging.discard(client)
        self._full.discard(client)
        self._routes.clear()
        self._inbox.client_gone(client)
        self.pass_on_held()

    def clients(self, topic: str) -> list[Client]:
        """The clients subscribed to a topic."""
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
        return clients

    def subscribed_literally(self, topic: str) -> Iterator[Client]:
        """The clients that named this topic itself: a pattern such as `*` does not match a reserved one."""
        return (client for client, patterns in self._patterns.items() if topic in patterns)

    def distribute(self, message: MessageReceived) -> None:
        """Send a message to the clients subscribed to its topic. One with a receipt goes through the inbox."""
        header = _header(
            message.source, message.topic, message.type_name, message.priority, message.broadcast, message.number
        )
        clients = self.clients(message.topic)
        if message.receipt is None:
            if clients:
                frame = encode_frame(header, message.payload)
                for client in clients:
                    client.send_encoded(frame)
            return
        key = self._inbox.add(message)
        self._send_held(clients, key, header, message.payload)
        if self._inbox.needs_flush:
            self._spawn(self._inbox.flush())
        if message.number is not None and self._reads:
            self._reads.pop((message.source, message.topic, message.number), None)
            if not self._reads:
                self.pass_on_held()

    def _send_held(self, clients: list[Client], key: int, header: Header, payload: bytes) -> None:
        for client in clients:
            acknowledges = client in self._acknowledging
            if client.send_encoded(encode_frame({**header, "receipt": key} if acknowledges else header, payload)):
                self._inbox.on_sent(key, client, acknowledges=acknowledges)
            else:
                self._full.add(client)
        self._inbox.on_distributed(key)

    def _has_taker(self, topic: str) -> bool:
        """Whether a program that is subscribed to the topic has room for a message."""
        self._full = {client for client in self._full if client.backlog_bytes()}
        return any(client not in self._full for client in self.clients(topic))

    def pass_on_held(self) -> None:
        """Send messages that no program is reading to the programs subscribed now, as far as these have room."""
        if not self._passing_on and any(self._has_taker(topic) for topic in self._inbox.topics()):
            self._passing_on = True
            self._spawn(self._send_from_disk())

    async def _send_from_disk(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            expired_at = loop.time() - READ_TIMEOUT_S
            self._reads = {item: at for item, at in self._reads.items() if at > expired_at}
            for key in self._inbox.waiting(self._has_taker):
                topic = self._inbox.topic(key)
                if topic is None or not self._has_taker(topic):
                    continue
                if (item := self._inbox.item(key)) is not None:
                    if len(self._reads) < MAX_READS:
                        self._reads[item] = loop.time()
                        self._inbox.request_item(key)
                    continue
                held = await loop.run_in_executor(None, self._inbox.read, key)
                if held is not None and self._inbox.is_waiting(key):
                    priority = self._priority(held.topic)
                    header = _header(held.peer, held.topic, held.type_name, priority, False, None)
                    self._send_held(self.clients(held.topic), key, header, held.payload)
        finally:
            self._passing_on = False


def _header(source: str, topic: str, type_name: str, priority: int, broadcast: bool, number: int | None) -> Header:
    header: Header = {
        "event": "message",
        "source": source,
        "topic": topic,
        "type": type_name,
        "priority": priority,
        "broadcast": broadcast,
    }
    if number is not None:
        header["number"] = number
    return header
