"""A quiet node has nothing to send, to report or to do, so a driver may skip it."""

from __future__ import annotations

from tests.udp_mesh.core.pair import World, settings
from udp_mesh.core.settings import Topic

TOPICS = (Topic("stop", priority=0), Topic("map", priority=9, compression=True))


class Watched(World):
    """Checks before every call to a node whether `is_quiet` was right."""

    looks = quiet = 0

    def _pump(self, name: str) -> None:
        node = self.nodes[name]
        due = node.next_timer()
        events = len(self.events[name])
        is_quiet = node.is_quiet and (due is None or due > self.now)
        sent: list[object] = []
        self.tap = lambda source, datagram, now: sent.append(datagram)
        super()._pump(name)
        self.looks += 1
        if is_quiet:
            self.quiet += 1
            assert not sent
            assert len(self.events[name]) == events
        # Packets held back by pacing wait for a timer, not for another call.
        assert not node.has_datagrams


def test_skipping_a_quiet_node_misses_nothing() -> None:
    world = Watched(seed=3)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    world.run(2.0)
    for pipe in world.pipes.values():
        pipe.loss = 0.1
    world.send("a", "map", bytes(range(256)) * 4000, "b")

    def stop() -> None:
        world.send("b", "stop", b"now", "a")

    for number in range(40):
        world.at(world.now + 0.05 * number, stop)
    world.run(4.0)
    assert world.quiet > 0.2 * world.looks


def test_receiving_bulk_needs_few_more_timers_than_idling() -> None:
    """Each wake-up costs ten times what a datagram costs: acknowledgments already sent need no timer."""
    world = World(seed=5)
    for name in ("a", "b"):
        world.add(settings(name, *TOPICS))
    world.run(3.0)
    called = 0
    handle_timer = world.nodes["b"].handle_timer

    def count(now: float) -> None:
        nonlocal called
        called += 1
        handle_timer(now)

    world.nodes["b"].handle_timer = count  # type: ignore[method-assign]
    world.run(5.0)
    idle, called = called, 0
    for _ in range(40):
        world.send("a", "map", world.rng.randbytes(200_000), "b")
    before = world.nodes["b"].conditions(world.now).counters.datagrams_received
    world.run(5.0)
    assert world.nodes["b"].conditions(world.now).counters.datagrams_received > before + 2000
    assert called < 3 * idle
