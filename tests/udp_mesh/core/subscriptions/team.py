"""Nodes that send selectively, on modeled links; a program's subscription is `read(...)`."""

from __future__ import annotations

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.endpoint import Endpoint
from udp_mesh.core.events import Event, MessageReceived
from udp_mesh.core.settings import Settings, Topic
from udp_mesh.core.subscriptions.messages import Bounds, Subscription
from udp_mesh.core.subscriptions.own import STARTING_S

TOPICS = (
    Topic("map"),
    Topic("status", reliable=False),
    Topic("stop", priority=0),
    Topic("kept", always=True),
)


def config(name: str, *topics: Topic, **changes: object) -> Settings:
    return settings(name, *(topics or TOPICS), **{"selective": True, **changes})


def read(world: World, name: str, *patterns: str, rate_hz: float | None = None, max_age_s: float | None = None) -> None:
    """The programs of this node read these topics, and nothing else."""
    bounds = Bounds(rate_hz, max_age_s)
    node: Endpoint = world.nodes[name]
    node.selective.set_subscriptions([Subscription(pattern, bounds) for pattern in patterns], world.now)


def met(*configs: Settings, seed: int = 1) -> World:
    """Nodes that have met, whose programs read nothing, and who know that of each other."""
    world = World(seed)
    for one in configs or (config("a"), config("b")):
        world.add(one)
    for name in world.nodes:
        read(world, name)
    world.run(STARTING_S)
    for source in world.nodes:
        for peer in world.nodes:
            if peer != source:
                world.send(source, "any", b"hello", peer)
    world.run(2.0)
    return world


def received(world: World, name: str, topic: str) -> list[bytes]:
    found: list[Event] = world.events_of(name, MessageReceived)
    return [event.payload for event in found if isinstance(event, MessageReceived) and event.topic == topic]


def outcomes(world: World, name: str, kind: type, topic: str) -> list[Event]:
    return [event for event in world.events_of(name, kind) if getattr(event, "topic", "") == topic]
