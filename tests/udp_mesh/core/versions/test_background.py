"""A large base is copied and indexed beside the node: meanwhile everything else is sent, and nothing is polled."""

from __future__ import annotations

from collections.abc import Callable

from tests.udp_mesh.core.pair import World
from tests.udp_mesh.core.versions.test_versions import MAP, counters, received, send_all, versions_of_a_map, world
from udp_mesh.core.events import MessageExpired
from udp_mesh.core.settings import Topic
from udp_mesh.core.versions.encoding import BACKGROUND_FROM_BYTES

ESTOP = Topic("estop", priority=0)
SIZE = 2 * BACKGROUND_FROM_BYTES


class Held:
    """A `Background` whose work waits for `release`, or fails."""

    def __init__(self) -> None:
        self.works: list[Callable[[], None]] = []
        self._done = 0

    def __call__(self, work: Callable[[], None]) -> Callable[[], bool]:
        self.works.append(work)
        number = len(self.works)
        return lambda: self._done >= number

    def release(self) -> None:
        self.works[self._done]()
        self._done += 1

    def fail(self) -> None:
        self._done += 1


def with_a_base(topic: Topic, first: bytes) -> tuple[World, Held]:
    """Two nodes of which `b` has the first version, and the background of `a`."""
    made = world(topic, ESTOP)
    send_all(made, [first], every_s=6.0)
    background = Held()
    made.nodes["a"]._state.versions.background = background
    return made, background


def test_urgent_messages_are_sent_while_a_base_is_indexed_and_the_node_rests() -> None:
    first, second = versions_of_a_map(2, SIZE)
    made, background = with_a_base(MAP, first)
    send_all(made, [second])
    assert len(background.works) == 1
    # only heartbeats and maintenance are due, not the encoding
    due = made.nodes["a"].next_timer()
    assert due is not None
    assert due > made.now
    made.send("a", "estop", b"stop", "b")
    made.run(0.2)
    assert received(made, "b", "estop") == [b"stop"]
    assert received(made, "b") == [first]
    background.release()
    made.run(3.0)
    assert received(made, "b") == [first, second]
    assert counters(made, "a").differences_sent == 1


def test_if_the_work_fails_the_whole_is_sent() -> None:
    first, second = versions_of_a_map(2, SIZE)
    made, background = with_a_base(MAP, first)
    send_all(made, [second])
    background.fail()
    made.run(6.0)
    assert received(made, "b") == [first, second]
    assert (counters(made, "a").whole_sent, counters(made, "a").differences_sent) == (2, 0)


def test_a_version_that_is_replaced_meanwhile_is_not_sent() -> None:
    first, second, third = versions_of_a_map(3, SIZE)
    made, background = with_a_base(Topic("map", delta=True, keep_last=1), first)
    send_all(made, [second, third])
    assert len(made.events_of("a", MessageExpired)) == 1
    for _ in range(2):
        if len(background.works) > background._done:
            background.release()
        made.run(3.0)
    assert received(made, "b") == [first, third]


def test_small_bases_need_no_background() -> None:
    first, second = versions_of_a_map(2, BACKGROUND_FROM_BYTES - 1000)
    made, background = with_a_base(MAP, first)
    send_all(made, [second], every_s=3.0)
    assert background.works == []
    assert received(made, "b") == [first, second]
