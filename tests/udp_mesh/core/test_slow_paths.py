"""A path that becomes a hundred times slower is measured again, not filled with copies of what is still in flight."""

import pytest

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.events import MessageDelivered, MessageReceived
from udp_mesh.core.sender.send_quota import MAX_URGENT_WAIT_S
from udp_mesh.core.sender.send_state import SendState
from udp_mesh.core.settings import Topic

TOPICS = (Topic("status", priority=0), Topic("map", priority=7), Topic("video", priority=9, reliable=False))


@pytest.mark.parametrize(
    ("rate_bits_per_s", "delay_s", "urgent_within_s"),
    [
        # A full queue of this link holds six seconds.
        (200e3, 0.01, 1.5),
        # The pauses of a continuously sending application say nothing about the queue.
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
    for path in world.pipes.values():
        path.rate_bits_per_s = 20e6
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
    for path in world.pipes.values():
        path.rate_bits_per_s, path.delay_s = rate_bits_per_s, delay_s
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


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("loss", [0.0, 0.1])
def test_in_flight_packets_on_a_path_that_became_slow_do_not_block_urgent_messages(seed: int, loss: float) -> None:
    """Hundreds of packets may be in the path's queue, or lost without notice: urgent ones join them."""
    world = World(seed=seed)
    for name in "ab":
        world.add(settings(name, *TOPICS))
    world.run(3.0)
    for path in world.pipes.values():
        path.rate_bits_per_s, path.loss = 20e6, loss
    world.send("a", "map", bytes(20_000_000), "b")
    world.run(2.0)
    for path in world.pipes.values():
        path.rate_bits_per_s = 200e3
    sender = world.nodes["a"]._state.peer_table.peers["b"].open_sender()
    for number in range(200):
        world.send("a", "status", b"%d" % number, "b")
        world.run(MAX_URGENT_WAIT_S + 0.001)
        waiting = [message for message in sender.pending if message.priority == 0 and not message.started]
        # An unresponsive peer gets probes instead.
        assert not waiting or sender.state is SendState.UNRESPONSIVE


def test_pacing_debt_from_a_slow_path_does_not_delay_messages_after_recovery() -> None:
    """Probes and bursts are sent ahead of the pace; that debt once blocked for a minute at the pace of a slow path."""
    world = World(seed=1)
    for name in "ab":
        world.add(settings(name, *TOPICS))
    world.run(3.0)
    world.send("a", "map", bytes(50_000), "b")
    world.run(3.0)
    world.nodes["a"]._state.peer_table.peers["b"].open_sender().pacer.on_sent(100, world.now, 1.0)
    world.send("a", "map", bytes(50_000), "b")
    assert world.run(2.0, until=lambda: len(world.events_of("a", MessageDelivered)) == 2)
