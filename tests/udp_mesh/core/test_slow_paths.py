"""A path that becomes a hundred times slower is measured anew, not filled with copies of what is still on its way."""

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageReceived
from udp_mesh.core.settings import Topic

TOPICS = (Topic("status", priority=0), Topic("map", priority=7), Topic("video", priority=9, reliable=False))


@pytest.mark.parametrize(
    ("rate_bits_per_s", "delay_s", "urgent_within_s"),
    [
        # a full queue of this link holds six seconds
        (200e3, 0.01, 1.5),
        # the pauses of an application that sends on and on say nothing of the queue
        (1e6, 0.01, 0.1),
        (20e6, 0.8, 0.9),
    ],
)
def test_urgent_messages_stay_urgent_on_a_path_that_became_slow(
    rate_bits_per_s: float, delay_s: float, urgent_within_s: float
) -> None:
    world = World(seed=1)
    for name in "ab":
        world.add(settings(name, *TOPICS))
    world.run(3.0)
    for way in world.pipes.values():
        way.rate_bits_per_s = 20e6
    sent: dict[bytes, float] = {}

    def publish() -> None:
        for source, target in (("a", "b"), ("b", "a")):
            payload = f"{source}{len(sent)}".encode().ljust(200)
            sent[payload] = world.now
            world.send(source, "status", payload, target)
            if len(sent) % 20 == 1:
                world.send(source, "map", bytes(100_000), target)
            if len(sent) % 5 == 1:
                world.send(source, "video", bytes(20_000), target)
        world.at(world.now + 0.1, publish)

    world.at(world.now, publish)
    world.run(3.0)
    for way in world.pipes.values():
        way.rate_bits_per_s, way.delay_s = rate_bits_per_s, delay_s
    slow_since = world.now
    world.run(30.0)
    took = {
        event.payload: at - sent[event.payload]
        for at, event in world.events["b"]
        if isinstance(event, MessageReceived) and event.topic == "status"
    }
    ends = (slow_since + 16.0, world.now - 3.0)
    settled = [payload for payload, at in sent.items() if payload[:1] == b"a" and ends[0] < at < ends[1]]
    assert len(settled) > 50
    late = [payload for payload in settled if took.get(payload, 99.0) > urgent_within_s]
    assert len(late) <= len(settled) // 50, sorted(took.get(payload, 99.0) for payload in late)
