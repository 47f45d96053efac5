"""With `keep_last`, a message whose fragments were lost after a newer one was accepted is not sent again."""

from __future__ import annotations

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import ExpiryReason, MessageDelivered, MessageExpired, MessageReceived
from udp_mesh.core.settings import Topic

POSE = Topic("pose", priority=6, keep_last=1)


def test_a_lost_message_that_was_replaced_meanwhile_ends_as_superseded() -> None:
    world = World(seed=5)
    for name in ("a", "b"):
        world.add(settings(name, POSE))
    world.run(3.0)
    pipe = world.pipes["a", "b"]
    pipe.up = False
    first = world.send("a", "pose", b"old", "b")
    world.run(0.01)
    second = world.send("a", "pose", b"new", "b")
    world.run(0.01)
    pipe.up = True
    world.run(5.0)
    (expired,) = world.events_of("a", MessageExpired)
    (delivered,) = world.events_of("a", MessageDelivered)
    assert isinstance(expired, MessageExpired)
    assert isinstance(delivered, MessageDelivered)
    assert (expired.message_id, expired.reason) == (first, ExpiryReason.SUPERSEDED)
    assert delivered.message_id == second
    payloads = [event.payload for event in world.events_of("b", MessageReceived) if isinstance(event, MessageReceived)]
    assert payloads == [b"new"]
