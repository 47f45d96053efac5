"""Slots: a limit per mesh and one for the bench, which follow how fast logins are."""

from __future__ import annotations

import threading

from hypothesis import given
from hypothesis import strategies as st

from meshctl.nodes.slots import BENCH_SLOTS, MESH_SLOTS, AdaptiveLimit, ChannelSlots, nodes_in_work, transfers_at_once


def test_the_limit_grows_with_fast_logins_and_shrinks_once_per_slow_batch() -> None:
    limit = AdaptiveLimit(8, 32)
    for _ in range(100):
        limit.login_ended(0.5)
    assert limit.slots == 32
    # all that were under way together are slow: one sign, not thirty-two
    for _ in range(32):
        limit.login_ended(20.0)
    assert limit.slots == 24
    limit.login_ended(20.0)
    assert limit.slots == 18


def test_a_moderately_slow_login_does_not_shrink_the_limit() -> None:
    limit = AdaptiveLimit(8, 32)
    limit.login_ended(0.5)
    before = limit.slots
    limit.login_ended(2.5)
    assert limit.slots == before + 1


@given(st.lists(st.floats(min_value=0, max_value=1e6)))
def test_the_limit_stays_between_1_and_its_maximum(logins: list[float]) -> None:
    limit = AdaptiveLimit(8, 32)
    for took_s in logins:
        limit.login_ended(took_s)
        assert 1 <= limit.slots <= 32


def test_each_mesh_has_its_own_slots() -> None:
    slots = ChannelSlots()
    for number in range(MESH_SLOTS[0] + 1):
        slots.assign(f"b{number:02}", "main")
    slots.assign("far", "far")
    held = [slots.acquire(f"b{number:02}") for number in range(MESH_SLOTS[0])]
    waiting = threading.Thread(target=lambda: slots.acquire(f"b{MESH_SLOTS[0]:02}"))
    waiting.start()
    # the channel of another mesh, and the bench, are free
    slots.acquire("far").release()
    for _ in range(BENCH_SLOTS[0]):
        slots.acquire("on the bench")
    waiting.join(0.2)
    assert waiting.is_alive()
    held[0].release()
    waiting.join(30)
    assert not waiting.is_alive()


def test_releasing_a_slot_twice_frees_it_once() -> None:
    slots = ChannelSlots()
    slots.assign("b01", "main")
    with slots.use("b01") as slot:
        slot.release()
    for _ in range(MESH_SLOTS[0]):
        slots.acquire("b01")
    blocked = threading.Thread(target=lambda: slots.acquire("b01").release(), daemon=True)
    blocked.start()
    blocked.join(0.2)
    assert blocked.is_alive()


def test_the_inventory_sets_an_upper_bound() -> None:
    assert nodes_in_work(3) == transfers_at_once(3) == 3
    assert nodes_in_work(None) > BENCH_SLOTS[1]
