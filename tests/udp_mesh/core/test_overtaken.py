"""Urgent packets overtake others in a radio, so their arrival does not reveal the loss of others: only time does."""

import random
from dataclasses import dataclass

import pytest

from tests.udp_mesh.core.pair import Pipe, World, settings
from udp_mesh.core.events import MessageDelivered, PeerOnline
from udp_mesh.core.settings import Topic

TOPICS = (Topic("telemetry", priority=0), Topic("map", priority=8))
LARGE_BYTES = 1000


@dataclass
class Wall(Pipe):
    """Loses large datagrams while the outage lasts."""

    stands: bool = False

    def carry(self, size_bytes: int, now: float, rng: random.Random) -> float | None:
        if self.stands and size_bytes > LARGE_BYTES:
            self.dropped += 1
            return None
        return Pipe.carry(self, size_bytes, now, rng)


@pytest.mark.parametrize("telemetry_hz", [10, 20, 50, 200])
def test_bulk_that_was_lost_all_at_once_is_sent_again_while_urgent_messages_keep_arriving(telemetry_hz: int) -> None:
    world = World(seed=1)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    walls = [Wall(delay_s=0.05) for _ in world.pipes]
    world.pipes.update(zip(world.pipes, walls, strict=True))
    assert world.run(20.0, until=lambda: bool(world.events_of("a", PeerOnline) and world.events_of("b", PeerOnline)))

    def report() -> None:
        world.send("a", "telemetry", bytes(100), "b")

    def fall() -> None:
        for wall in walls:
            wall.stands = False

    for wall in walls:
        wall.stands = True
    for number in range(20 * telemetry_hz):
        world.at(world.now + number / telemetry_hz, report)
    world.send("a", "map", bytes(50_000), "b")
    world.at(world.now + 0.08, fall)

    def maps() -> list[str]:
        events = [event for event in world.events_of("a", MessageDelivered) if isinstance(event, MessageDelivered)]
        return [event.topic for event in events if event.topic == "map"]

    assert world.run(5.0, until=lambda: bool(maps()))
    assert any(wall.dropped for wall in walls)
