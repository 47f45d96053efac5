"""The replay window equals a plain set of numbers, within its width."""

import random

from hypothesis import given
from hypothesis import strategies as st

from udp_mesh.crypto.replay import AGE_STEP_S, WINDOW_PACKETS, ReplayWindow


@given(st.integers(0, 1 << 40), st.lists(st.integers(-5000, 5000), max_size=80), st.integers(0, 10_000))
def test_the_window_equals_a_plain_set(start: int, steps: list[int], floor: int) -> None:
    window, seen = ReplayWindow(), set[int]()
    window.raise_floor(floor)
    number = start
    for step in steps:
        number = max(0, number + step)
        fresh = number not in seen and number >= floor
        expected_certain = not seen or number > max(seen) - WINDOW_PACKETS
        if expected_certain:
            assert window.would_accept(number) == fresh
            assert window.accept(number) == fresh
        else:
            assert not window.accept(number) or fresh
        seen.add(number)


def test_no_number_is_accepted_twice_in_a_long_random_walk() -> None:
    source, window, accepted, number = random.Random(4), ReplayWindow(), set[int](), 0
    for _ in range(20_000):
        number = max(0, number + source.choice((1, 1, 1, 2, 70, -3, -64, -200, 300)))
        if window.accept(number):
            assert number not in accepted
            accepted.add(number)
    assert len(accepted) > 5_000
    assert window.largest == max(accepted)


def test_numbers_older_than_the_window_count_as_seen() -> None:
    window = ReplayWindow()
    assert window.accept(1_000_000)
    assert window.accept(1_000_000 - WINDOW_PACKETS)
    assert not window.accept(1_000_000 - WINDOW_PACKETS - 128)


@given(st.sets(st.integers(0, 300), min_size=1), st.integers(0, 300), st.integers(1, 200), st.integers(1, 20))
def test_the_accepted_share_counts_the_newest_numbers(numbers: set[int], first: int, newest: int, least: int) -> None:
    window = ReplayWindow()
    for number in sorted(numbers):
        window.accept(number)
    counted = range(max(first, max(numbers) - newest + 1), max(numbers) + 1)
    expected = len(numbers.intersection(counted)) / len(counted) if len(counted) >= least else None
    assert window.accepted_share(first, newest, least) == expected


def test_a_number_is_too_old_two_steps_after_a_larger_one_and_the_floor_never_sinks() -> None:
    window = ReplayWindow()
    window.accept(100)
    for step in range(3):
        window.age(step * AGE_STEP_S)
        assert window.would_accept(50)
    window.age(3 * AGE_STEP_S)
    assert not window.would_accept(50)
    assert window.would_accept(101)
    window.raise_floor(500)
    window.age(4 * AGE_STEP_S)
    assert window.floor == 500
