"""The queue of a hop: strict priority, origins in turn, bounds per origin and per previous hop, nothing twice."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.core.relaying.hop_queue import (
    CARRY_OVERHEAD_BYTES,
    MAX_HOP_BYTES,
    MAX_ORIGIN_BYTES,
    HopQueue,
    QueueBudget,
    QueuedCarry,
)
from udp_mesh.wire.relay import Carry

OWN = bytes(16)


def item(priority: int, origin: int, size: int = 1000, previous: int = 1, serial: int = 0) -> QueuedCarry:
    carry = Carry(priority, 4, bytes([origin]) * 8, bytes(8), (), serial.to_bytes(4, "big") + bytes(size - 4))
    return QueuedCarry(carry, bytes([previous]) * 16, 0.0)


@given(st.lists(st.tuples(st.integers(0, 15), st.integers(1, 4)), max_size=60))
def test_each_datagram_leaves_once_and_none_before_a_more_urgent_one(entries: list[tuple[int, int]]) -> None:
    queue = HopQueue(QueueBudget(OWN))
    for serial, (priority, origin) in enumerate(entries):
        queue.push(item(priority, origin, serial=serial))
    left = []
    while (popped := queue.pop(0.0)) is not None:
        left.append(popped.carry)
    assert [carry.priority for carry in left] == sorted(priority for priority, _ in entries)
    assert len({bytes(carry.datagram) for carry in left}) == len(entries)
    assert queue.bytes == 0
    assert not queue


def test_a_flood_fills_only_its_own_share_and_its_urgent_datagrams_replace_its_others() -> None:
    budget = QueueBudget(OWN)
    queue = HopQueue(budget)
    for _ in range(1000):
        queue.push(item(9, 1))
    assert budget.memory_bytes <= MAX_ORIGIN_BYTES
    full = queue.bytes
    queue.push(item(0, 1))
    assert queue.bytes == full
    assert queue.first_level == 0
    queue.push(item(9, 2, previous=2))
    assert queue.bytes == full + 1000


def test_a_member_that_invents_origins_is_bounded_as_a_previous_hop() -> None:
    budget = QueueBudget(OWN)
    queue = HopQueue(budget)
    for origin in range(1, 101):
        for _ in range(20):
            queue.push(item(9, origin))
    assert budget.memory_bytes <= MAX_HOP_BYTES


def test_empty_datagrams_are_bounded_by_their_memory() -> None:
    budget = QueueBudget(OWN)
    queue = HopQueue(budget)
    for origin in range(1, 101):
        for _ in range(200):
            queue.push(item(9, origin, size=4))
    waiting = len(queue.drain())
    assert 0 < waiting <= MAX_HOP_BYTES // CARRY_OVERHEAD_BYTES
    assert queue.dropped == 20_000 - waiting
    assert budget.memory_bytes == 0


def test_an_urgent_datagram_replaces_those_of_others_behind_the_same_relay() -> None:
    queue = HopQueue(QueueBudget(OWN))
    for origin in range(1, 10):
        for _ in range(300):
            queue.push(item(9, origin))
    queue.push(item(9, 20, previous=2))
    full = queue.bytes
    queue.push(item(0, 10))
    assert queue.bytes == full
    left = queue.drain()
    assert (left[0].carry.priority, left[0].carry.origin[0]) == (0, 10)
    # Nothing that came from elsewhere made room for it.
    assert [each.carry.origin[0] for each in left if each.previous[0] == 2] == [20]


def test_nothing_as_urgent_makes_room() -> None:
    queue = HopQueue(QueueBudget(OWN))
    for origin in range(1, 10):
        for serial in range(300):
            queue.push(item(9, origin, serial=serial))
    full = queue.bytes
    queue.push(item(9, 10))
    assert queue.bytes == full
    assert 10 not in {each.carry.origin[0] for each in queue.drain()}


def test_origins_of_one_level_take_turns() -> None:
    queue = HopQueue(QueueBudget(OWN))
    for _ in range(5):
        queue.push(item(9, 1))
    queue.push(item(9, 2))
    origins = [popped.carry.origin[0] for popped in iter(lambda: queue.pop(0.0), None)]
    assert origins.index(2) == 1


def test_what_waited_too_long_is_dropped() -> None:
    queue = HopQueue(QueueBudget(OWN))
    queue.push(item(9, 1))
    assert queue.pop(10.0) is None
    assert queue.dropped == 1
