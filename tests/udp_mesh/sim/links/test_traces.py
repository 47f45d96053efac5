"""Courses of rate and delay: steps, integrals, and generators that depend on the seed alone."""

from itertools import pairwise

import pytest

from udp_mesh.sim.links.traces import WIFI_RATES, Steps, constant, handovers, mtu_hole, wifi_rate_walk


def test_a_value_holds_until_the_next_change() -> None:
    steps = Steps((0.0, 2.0, 3.0), (10.0, 0.0, 5.0))
    assert [steps.at(now) for now in (0.0, 1.9, 2.0, 3.0, 99.0)] == [10.0, 10.0, 0.0, 5.0, 5.0]
    assert steps.next_change(2.0) == 3.0
    assert steps.next_change(3.0) is None
    assert steps.integral(1.0, 4.0) == pytest.approx(10.0 + 0.0 + 5.0)
    assert steps.spans_of(0.0) == [(2.0, 3.0)]
    assert steps.spans_of(5.0) == [(3.0, float("inf"))]


@pytest.mark.parametrize("times", [(), (1.0,), (0.0, 2.0, 2.0)])
def test_step_times_must_start_at_zero_and_increase(times: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="found"):
        Steps(times, (1.0,) * len(times))


def test_a_rate_walk_moves_between_adjacent_rates_with_fades() -> None:
    walk = wifi_rate_walk(3, 120.0)
    assert walk == wifi_rate_walk(3, 120.0)
    assert walk != wifi_rate_walk(4, 120.0)
    heard = [WIFI_RATES.index(value) for value in walk.values if value]
    assert all(abs(later - earlier) <= 1 for earlier, later in pairwise(heard))
    assert len(walk.spans_of(0.0)) > 5
    assert all(0.1 <= end - start <= 0.5 for start, end in walk.spans_of(0.0))


def test_a_handover_changes_between_two_delays() -> None:
    delays = handovers(1, 60.0)
    assert set(delays.values) == {0.005, 0.075}
    assert all(a != b for a, b in pairwise(delays.values))


def test_an_mtu_hole_lowers_the_path_mtu() -> None:
    hole = mtu_hole(5.0, 1300)
    assert (hole.at(4.9), hole.at(5.0)) == (1500, 1300)
    assert constant(7.0).at(100.0) == 7.0
