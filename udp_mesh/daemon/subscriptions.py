"""Pass messages to local programs: live ones, and those that the inbox holds for them."""

from __future__ import annotations

import asyncio
import fnmatch
from collections.abc import Callable, Coroutine, Iterable, Iterator
from functools import reduce

from udp_mesh.client.mesh_client import Header, encode_frame
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.subscriptions.messages import MAX_ENTRIES, UNBOUNDED, Bounds, Subscription
from udp_mesh.daemon.api import Client, RequestError
from udp_mesh.daemon.inbox import Inbox, LoggedItem
from udp_mesh.daemon.interface import RESERVED_PREFIX
from udp_mesh.daemon.thinning import Thinning

MAX_PATTERNS = 1024
"""Patterns per client: each is matched against each new topic."""
MAX_ROUTES = 4096
"""Topics whose subscribers are remembered; a holder of the key could invent names without bound."""
MAX_READS = 64
"""Items of logs requested for programs and not delivered yet."""
READ_TIMEOUT_S = 30.0
"""An item that the log did not deliver for this long, such as one that it dropped meanwhile, no longer counts."""


class Subscriptions:
    """`spawn` runs a task; `priority` is that of a topic; `on_change` gets what programs read after each change."""

    def __init__(
        self,
        inbox: Inbox,
        spawn: Callable[[Coroutine[None, None, None]], None],
        priority: Callable[[str], int],
        on_change: Callable[[list[Subscription]], None] = lambda _: None,
    ) -> None:
        self._inbox = inbox
        self._spawn = spawn
        self._priority = priority
        self._on_change = on_change
        self._is_scheduled = False
        self._patterns: dict[Client, dict[str, Bounds]] = {}
        self._thinning: Thinning | None = None
        self._acknowledging: set[Client] = set()
        """Clients that acknowledge messages with receipts."""
        self._routes: dict[str, dict[Client, float | None]] = {}
        """By topic, its subscribers with the maximum rate of each."""
        self._passing_on = False
        self._full: set[Client] = set()
        """Clients that did not take a held message: they get no more until they have read what was sent to them."""
        self._reads: dict[LoggedItem, float] = {}
        """Items of logs being read for programs, with the time of the request."""

    def add(
        self, client: Client, patterns: list[str], bounds: Bounds = UNBOUNDED, *, acknowledge: bool = False
    ) -> None:
        """The last bounds of a pattern count. Raises RequestError for too many patterns."""
        wanted = {**self._patterns.get(client, {}), **dict.fromkeys(patterns, bounds)}
        if len(wanted) > MAX_PATTERNS:
            raise RequestError("too-many", f"a client may subscribe to at most {MAX_PATTERNS} patterns")
        self._patterns[client] = wanted
        if acknowledge:
            self._acknowledging.add(client)
        self._changed()
        self.pass_on_held()

    def _changed(self) -> None:
        """Announces all changes of this turn of the loop at once."""
        self._routes.clear()
        if not self._is_scheduled:
            self._is_scheduled = True
            asyncio.get_running_loop().call_soon(self.announce)

    def announce(self) -> None:
        """Passes on what programs read."""
        self._is_scheduled = False
        self._on_change(self.read_here())

    def remove(self, client: Client, patterns: list[str]) -> None:
        kept = {
            pattern: bounds for pattern, bounds in self._patterns.get(client, {}).items() if pattern not in patterns
        }
        self._patterns[client] = kept
        self._changed()

    def read_here(self) -> list[Subscription]:
        """Subscriptions of programs to topics that cross the network; everything if they are more than a peer accepts:
        every change goes through all clients' patterns."""
        found: dict[str, Bounds] = {}
        for patterns in self._patterns.values():
            for pattern, bounds in patterns.items():
                if not pattern.startswith(RESERVED_PREFIX):
                    found[pattern] = found[pattern].united(bounds) if pattern in found else bounds
            if len(found) > MAX_ENTRIES:
                return [Subscription("*")]
        return [Subscription(pattern, bounds) for pattern, bounds in found.items()]

    def remove_client(self, client: Client) -> None:
        self._patterns.pop(client, None)
        self._acknowledging.discard(client)
        self._full.discard(client)
        if self._thinning is not None:
            self._thinning.remove_client(client)
        self._changed()
        self._inbox.client_gone(client)
        self.pass_on_held()

    def clients(self, topic: str) -> dict[Client, float | None]:
        """The clients subscribed to a topic, with the maximum rate that each of them wants."""
        clients = self._routes.get(topic)
        if clients is None:
            clients = {}
            for client, patterns in self._patterns.items():
                matching = [bounds for pattern, bounds in patterns.items() if fnmatch.fnmatchcase(topic, pattern)]
                if matching:
                    clients[client] = reduce(Bounds.united, matching).rate_hz
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
                for client, rate_hz in clients.items():
                    if rate_hz is None:
                        client.send_encoded(frame)
                    else:
                        self._thinned().send(client, (message.topic, message.source), rate_hz, frame)
            return
        key = self._inbox.add(message)
        self._send_held(clients, key, header, message.payload)
        if self._inbox.needs_flush:
            self._spawn(self._inbox.flush())
        if message.number is not None and self._reads:
            self._reads.pop((message.source, message.topic, message.number), None)
            if not self._reads:
                self.pass_on_held()

    def _thinned(self) -> Thinning:
        if self._thinning is None:
            loop = asyncio.get_running_loop()
            self._thinning = Thinning(loop.time, loop.call_at)
        return self._thinning

    def _send_held(self, clients: Iterable[Client], key: int, header: Header, payload: bytes) -> None:
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
            # What follows on such a topic waits as well, which keeps its order.
            without_taker: set[str] = set()
            for key in self._inbox.waiting(self._has_taker):
                topic = self._inbox.topic(key)
                if topic is None or topic in without_taker:
                    continue
                if not self._has_taker(topic):
                    without_taker.add(topic)
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
