"""Which clients hear of the outcomes of the messages that they published."""

from __future__ import annotations

from collections import OrderedDict

from udp_mesh.daemon.api import Client

MAX_MESSAGES_TO_SEVERAL = 65_536
"""Of messages to several peers: nothing says which of their outcomes is the last one."""


class AwaitedOutcomes:
    """A message to one peer is remembered until it ends, for hours if it waits in an outbox."""

    def __init__(self) -> None:
        self._to_one: dict[int, Client] = {}
        """As many as the core has pending, which has its own limits."""
        self._to_several: OrderedDict[int, Client] = OrderedDict()
        self._publishers: set[Client] = set()

    def add(self, message: int, client: Client, *, destination: str | None) -> None:
        """A client published a reliable message; `destination` None: to the topic's destinations, or to all."""
        self._publishers.add(client)
        if destination is not None:
            self._to_one[message] = client
            return
        self._to_several[message] = client
        if len(self._to_several) > MAX_MESSAGES_TO_SEVERAL:
            self._to_several.popitem(last=False)

    def publisher(self, message: int) -> Client | None:
        """Whom to inform of an outcome of the message; None: no client asked."""
        return self._to_one.pop(message, None) or self._to_several.get(message)

    def remove_client(self, client: Client) -> None:
        """The client is gone."""
        if client not in self._publishers:
            return
        self._publishers.discard(client)
        for waiting in (self._to_one, self._to_several):
            for message in [message for message, publisher in waiting.items() if publisher is client]:
                del waiting[message]
