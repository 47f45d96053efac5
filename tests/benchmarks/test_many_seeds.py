"""The tables over many seeds: every cell is a row, with intervals over its seeds."""

from __future__ import annotations

import pytest

from benchmarks.many_seeds import RADIOS, cells, median_interval, tables
from mesh_sweep.cases import Case
from mesh_sweep.results import Result


def test_every_cell_is_named_once_and_belongs_to_a_table() -> None:
    assert len(set(cells())) == len(cells())
    assert {dict(cell)["set"] for cell in cells()} == {"hops", "teams", "guests", "logs"}
    assert all(list(cell) == sorted(cell) for cell in cells())


def test_a_row_has_the_median_of_the_seeds_with_its_interval_and_the_seeds_that_meet_the_goal() -> None:
    cell = (("loss", "0.05"), ("radio", RADIOS[0]), ("robots", "2"), ("set", "teams"))
    results = [
        Result(
            Case(cell, seed), {"of_ceiling": 0.8, "fairness": 1.0, "urgent_p99_s": p99_s, "met": float(p99_s <= 0.025)}
        )
        for seed, p99_s in enumerate((0.020, 0.022, 0.023, 0.024, 0.024, 0.026), 1)
    ]
    failed = Result(Case(cell, 7), failed="killed")
    last = tables([*results, failed]).splitlines()[-1]
    assert last == (
        "| 5% | access categories | 2 | 6 | 0.8 (0.8 to 0.8) | 1 (1 to 1) | 23.5 (20 to 26) | 5 of 6 (44% to 97%) |"
    )


@pytest.mark.parametrize(
    ("count", "low", "high"), [(5, None, None), (6, 1, 6), (8, 1, 8), (9, 2, 8), (20, 6, 15), (100, 40, 61)]
)
def test_the_interval_of_a_median_is_that_of_the_binomial_tables(
    count: int, low: float | None, high: float | None
) -> None:
    found = median_interval([float(value) for value in range(count, 0, -1)])
    assert (found.low, found.high) == (low, high)
    assert found.estimate == (count + 1) / 2
