"""Intervals against published tables, and their coverage against their promise."""

from __future__ import annotations

import random

import pytest

from mesh_sweep.intervals import mean_interval, share_interval, student_quantile


@pytest.mark.parametrize(
    ("degrees", "quantile"),
    [(1, 12.706), (2, 4.303), (4, 2.776), (9, 2.262), (29, 2.045), (100, 1.984), (10**6, 1.960)],
)
def test_students_quantiles_are_those_of_the_tables(degrees: int, quantile: float) -> None:
    assert student_quantile(0.975, degrees) == pytest.approx(quantile, abs=5e-4)


def test_wilsons_interval_is_that_of_the_literature() -> None:
    # Newcombe, Two-sided confidence intervals for the single proportion, 1998, table I
    for successes, count, low, high in ((81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0, 0.1611)):
        found = share_interval(successes, count)
        assert found.low == pytest.approx(low, abs=5e-5)
        assert found.high == pytest.approx(high, abs=5e-5)
    assert share_interval(29, 29).high == 1.0


def test_few_values_have_a_mean_and_no_interval() -> None:
    assert mean_interval([2.0]).low is None
    found = mean_interval([1.0, 1.0])
    assert (found.low, found.estimate, found.high) == (1.0, 1.0, 1.0)


def test_of_a_thousand_intervals_about_fifty_miss() -> None:
    rng = random.Random(1)
    missed = 0
    for _ in range(1000):
        found = mean_interval([rng.gauss(10.0, 3.0) for _ in range(5)])
        assert found.low is not None
        assert found.high is not None
        missed += not found.low <= 10.0 <= found.high
    assert 30 <= missed <= 75
