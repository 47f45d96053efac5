"""After an outage of seconds, new messages of any level arrive soon, and everything that waited is sent as well."""

from __future__ import annotations

import statistics

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import Event, MessageReceived, PeerOnline
from udp_mesh.core.settings import Topic

MAP = Topic("map", priority=8)
MAP_BYTES, MAP_HZ = 10_000, 5
OUTAGE_S = 9.0
RATE_BITS_PER_S = 1e6


def test_new_messages_are_not_held_up_by_those_that_waited() -> None:
    world = World(seed=7)
    for name in "ab":
        world.add(settings(name, MAP))
    for pipe in world.pipes.values():
        pipe.rate_bits_per_s = RATE_BITS_PER_S
    arrived: dict[int, float] = {}

    def on_event(name: str, event: Event, now: float) -> None:
        if isinstance(event, MessageReceived):
            arrived[int.from_bytes(event.payload[:4], "big")] = now

    world.on_event = on_event
    assert world.run(10.0, until=lambda: all(world.events_of(name, PeerOnline) for name in "ab"))
    began = world.now
    sent_at = [began + number / MAP_HZ for number in range(int(30 * MAP_HZ))]
    for number, at in enumerate(sent_at):
        payload = number.to_bytes(4, "big") + bytes(MAP_BYTES - 4)
        world.at(at, lambda payload=payload: world.send("a", "map", payload, "b"))  # type: ignore[misc]

    def up(value: bool) -> None:
        for pipe in world.pipes.values():
            pipe.up = value

    world.at(began + 5.0, lambda: up(False))
    returned = began + 5.0 + OUTAGE_S
    world.at(returned, lambda: up(True))
    world.run(60.0)
    assert len(arrived) == len(sent_at)
    soon_after = [arrived[number] - at for number, at in enumerate(sent_at) if returned + 0.5 <= at < returned + 4.0]
    # what waited takes OUTAGE_S * MAP_HZ * MAP_BYTES * 8 / RATE = 3.6 s of the link
    assert statistics.median(soon_after) < 1.0
