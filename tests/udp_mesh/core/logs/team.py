"""A team of nodes with logs in virtual time, whose links go up and down, and which restart with their stores."""

from __future__ import annotations

from collections.abc import Iterable

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageId, MessageReceived, Rejected
from udp_mesh.core.logs.store import MemoryLogStore
from udp_mesh.core.settings import Log, Topic

ARTIFACT = Topic("artifact", priority=4, log=Log(readers=("base",)))


class LogTeam(World):
    """`stores` survive a restart; every link starts down."""

    def __init__(self, *names: str, topics: Iterable[Topic] = (ARTIFACT,), seed: int = 1) -> None:
        super().__init__(seed)
        self.topics = tuple(topics)
        self.stores: dict[str, MemoryLogStore] = {}
        for name in names:
            self.start(name)
        self.separate()

    def start(self, name: str, **changes: object) -> None:
        """Start or restart a node."""
        if name not in self.stores:
            self.stores[name] = MemoryLogStore(self.rng.randbytes(32), clock=lambda: self.now)
        self.add(settings(name, *self.topics, **changes), log_store=self.stores[name])

    def stop(self, name: str) -> None:
        """Kill a node: what it did not store is lost."""
        self._fetch(name)
        del self.nodes[name]

    def separate(self) -> None:
        """Cut all links."""
        for pipe in self.pipes.values():
            pipe.up = False

    def connect(self, *names: str) -> None:
        """Bring up the links between these nodes, both ways."""
        for (source, target), pipe in self.pipes.items():
            if source in names and target in names:
                pipe.up = True

    def meet(self, *names: str, seconds: float, apart_s: float = 12.0) -> None:
        """Let nodes meet, then separate long enough for them to be offline."""
        self.connect(*names)
        self.run(seconds)
        self.separate()
        self.run(apart_s)

    def publish(self, name: str, payload: bytes, topic: str = "artifact") -> MessageId:
        result = self.send(name, topic, payload)
        assert not isinstance(result, Rejected), result
        assert isinstance(result, int)
        return MessageId(result)

    def read(self, name: str, topic: str = "artifact") -> list[tuple[str, int | None, bytes]]:
        """(source, number, payload) of everything that programs at a node received."""
        return [
            (event.source, event.number, event.payload)
            for event in self.events_of(name, MessageReceived)
            if isinstance(event, MessageReceived) and event.topic == topic
        ]
