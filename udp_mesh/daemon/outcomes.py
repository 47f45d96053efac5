"""The clients to inform of the outcomes of the messages that they published."""

from __future__ import annotations

from collections import OrderedDict
from typing import NamedTuple

from udp_mesh.core.events import Event
from udp_mesh.daemon.api import Client
from udp_mesh.daemon.status import event_json, event_name

MAX_MESSAGES_TO_SEVERAL = 65_536
"""Of messages to several peers: nothing says which of their outcomes is the last one."""


class Publisher(NamedTuple):
    """A client, and the id of its request."""

    client: Client
    request: object

    def report(self, event: Event) -> None:
        """Send the client how its message ended."""
        outcome = event_name(event).removeprefix("message-")
        self.client.send_event({**event_json(event), "event": "outcome", "outcome": outcome, "request": self.request})


class AwaitedOutcomes:
    """A message to one peer is remembered until it ends, for hours if it waits in an outbox."""

    def __init__(self) -> None:
        self._to_one: dict[int, Publisher] = {}
        """As many as the core has pending, which has its own limits."""
        self._to_several: OrderedDict[int, Publisher] = OrderedDict()
        self._clients: set[Client] = set()

    def add(self, message: int, publisher: Publisher, *, destination: str | None) -> None:
        """A client published a reliable message; `destination` None: to the topic's destinations, or to all."""
        self._clients.add(publisher.client)
        if destination is not None:
            self._to_one[message] = publisher
            return
        self._to_several[message] = publisher
        if len(self._to_several) > MAX_MESSAGES_TO_SEVERAL:
            self._to_several.popitem(last=False)

    def publisher(self, message: int) -> Publisher | None:
        """The client to inform of an outcome of the message; None: no client asked."""
        return self._to_one.pop(message, None) or self._to_several.get(message)

    def remove_client(self, client: Client) -> None:
        """The client is gone."""
        if client not in self._clients:
            return
        self._clients.discard(client)
        for waiting in (self._to_one, self._to_several):
            for message in [message for message, publisher in waiting.items() if publisher.client is client]:
                del waiting[message]
