"""Growth into a link without a queue: it starts small, doubles, and stops at a full link."""

import pytest

from udp_mesh.core.congestion.growth import (
    FIRST_GROWTH_ROUND_TRIPS,
    FIRST_GROWTH_S,
    FULL_ROUNDS,
    GROWTH,
    GROWTH_AFTER_ROUNDS,
    GROWTH_PAUSE_S,
    Growth,
)

CAPACITY = 1000.0


def steps(growth: Growth, min_rtt: float, capacities: list[float]) -> list[float | None]:
    """What is added to a window of one round trip in each round without a queue."""
    return [
        growth.packets(min_rtt * capacity, capacity, min_rtt, is_empty=True, now=number * min_rtt)
        for number, capacity in enumerate(capacities)
    ]


def test_growth_starts_only_after_several_empty_rounds() -> None:
    growth = Growth()
    assert steps(growth, 0.02, [CAPACITY] * (GROWTH_AFTER_ROUNDS - 1)) == [None] * (GROWTH_AFTER_ROUNDS - 1)
    assert growth.packets(20.0, CAPACITY, 0.02, is_empty=False, now=0.1) is None
    assert growth.packets(20.0, CAPACITY, 0.02, is_empty=True, now=0.1) is None


def test_growth_steps_double_on_a_long_path() -> None:
    capacities = [CAPACITY * 1.2**number for number in range(5)]
    grown = steps(Growth(), 0.6, capacities)[GROWTH_AFTER_ROUNDS - 1 :]
    first_s = FIRST_GROWTH_ROUND_TRIPS * 0.6
    expected = [first_s * 2**number * capacity for number, capacity in enumerate(capacities[2:])]
    assert grown == pytest.approx(expected)
    assert expected[0] < (GROWTH - 1) * 0.6 * capacities[2] / 5


def test_a_growth_step_is_a_fraction_of_the_window_on_a_short_path() -> None:
    grown = steps(Growth(), 0.01, [CAPACITY] * GROWTH_AFTER_ROUNDS)[-1]
    assert grown == pytest.approx((GROWTH - 1) * 10)
    assert (GROWTH - 1) * 0.01 < FIRST_GROWTH_S


def test_a_full_link_pauses_growth() -> None:
    growth = Growth()
    found = steps(growth, 0.02, [CAPACITY] * (GROWTH_AFTER_ROUNDS + FULL_ROUNDS))
    assert found[-1] == 0.0
    assert not growth.active
    pause_rounds = int(GROWTH_PAUSE_S / 0.02)
    assert not any(steps(growth, 0.02, [CAPACITY] * pause_rounds))
