"""A case that kills workers is found; no other one is blamed, and all others run."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from mesh_sweep.cases import Case
from mesh_sweep.dispatch import MAX_LONE_DEATHS, Dispatch


def play(count: int, width: int, killers: set[int], order: list[int]) -> tuple[set[int], set[int], int]:
    """A pool that breaks whenever a killer runs: (done, given up, times that it broke)."""
    dispatch = Dispatch(Case((), seed) for seed in range(count))
    running: list[Case] = []
    done: set[int] = set()
    given_up: set[int] = set()
    broken = 0
    while not dispatch.is_finished:
        running += dispatch.take(width)
        assert running
        assert len(running) <= width
        if any(case.seed in killers for case in running):
            broken += 1
            given_up |= {case.seed for case in dispatch.died(running)}
            running = []
            continue
        case = running.pop(order[len(done) % len(order)] % len(running) if order else 0)
        dispatch.done(case)
        done.add(case.seed)
    return done, given_up, broken


@given(st.integers(0, 40), st.integers(1, 20), st.sets(st.integers(0, 39), max_size=6), st.lists(st.integers(0, 9)))
def test_exactly_the_killers_are_given_up(count: int, width: int, killers: set[int], order: list[int]) -> None:
    done, given_up, _ = play(count, width, killers, order)
    assert given_up == {seed for seed in killers if seed < count}
    assert done == set(range(count)) - killers


def test_one_killer_among_many_costs_few_rounds() -> None:
    # 128 suspects at once, then 32, 8, 2, and alone twice
    assert play(1000, 128, {70}, [])[2] <= 5 + MAX_LONE_DEATHS


def test_a_case_that_dies_once_alone_runs_again() -> None:
    dispatch = Dispatch([Case((), 1)])
    assert dispatch.take(1) == [Case((), 1)]
    assert dispatch.died([Case((), 1)]) == []
    assert dispatch.take(1) == [Case((), 1)]
    dispatch.done(Case((), 1))
    assert dispatch.is_finished
