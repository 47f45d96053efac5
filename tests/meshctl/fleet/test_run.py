"""Work on many nodes: one outcome each, bounded concurrency, stopping."""

from __future__ import annotations

import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from meshctl.errors import InputError, NodeError, Unreachable
from meshctl.fleet import Event, EventKind, FailureBudget, Interrupt, Outcome, Result, run, totals

NODES = [f"b{index:02}" for index in range(12)]


def done(node: str) -> Outcome:
    return Outcome(node, Result.DONE)


@given(st.lists(st.sampled_from(["done", "fails", "silent"]), min_size=1, max_size=12), st.integers(1, 5))
def test_every_node_has_exactly_one_outcome_in_the_given_order(fates: list[str], parallel: int) -> None:
    fate_of = dict(zip(NODES, fates, strict=False))

    def work(node: str) -> Outcome:
        if fate_of[node] == "fails":
            raise NodeError("board differs", hint="look")
        if fate_of[node] == "silent":
            raise Unreachable("no answer")
        return done(node)

    outcomes = run(fate_of, work, parallel=parallel)
    assert list(outcomes) == list(fate_of)
    expected = {"done": Result.DONE, "fails": Result.FAILED, "silent": Result.UNREACHABLE}
    assert {node: outcome.result for node, outcome in outcomes.items()} == {
        node: expected[fate] for node, fate in fate_of.items()
    }


def test_exactly_the_allowed_number_of_nodes_runs_in_parallel() -> None:
    lock, full = threading.Lock(), threading.Barrier(3, timeout=60)
    in_work, most = set[str](), 0

    def work(node: str) -> Outcome:
        nonlocal most
        with lock:
            in_work.add(node)
            most = max(most, len(in_work))
        full.wait()
        with lock:
            in_work.discard(node)
        return done(node)

    run(NODES, work, parallel=3)
    assert most == 3


def test_after_the_budget_is_spent_no_further_node_is_begun() -> None:
    begun: list[str] = []

    def work(node: str) -> Outcome:
        begun.append(node)
        return Outcome(node, Result.ROLLED_BACK if node in ("b01", "b03") else Result.DONE)

    budget = FailureBudget(2)
    outcomes = run(NODES, work, parallel=1, budget=budget)
    assert begun == NODES[:4]
    assert {outcome.result for node, outcome in outcomes.items() if node not in begun} == {Result.PENDING}
    assert outcomes["b05"].reason == "stopped after 2 failed nodes"
    assert all(outcome.result is Result.PENDING for outcome in run(NODES, work, parallel=4, budget=budget).values())


def test_an_interrupt_lets_running_nodes_finish_and_starts_no_more() -> None:
    interrupt = Interrupt()

    def work(node: str) -> Outcome:
        interrupt.request()
        return done(node)

    outcomes = run(NODES, work, parallel=1, interrupt=interrupt)
    assert outcomes["b00"].result is Result.DONE
    assert outcomes["b01"] == Outcome("b01", Result.PENDING, "interrupted before it started")
    assert interrupt.stopping
    assert not interrupt.leaving
    interrupt.request()
    assert interrupt.leaving


def test_an_unexpected_exception_is_reraised() -> None:
    def work(node: str) -> Outcome:
        raise RuntimeError(f"bug at {node}")

    with pytest.raises(RuntimeError, match="bug at b00"):
        run(NODES, work, parallel=1)


def test_an_input_error_aborts_the_whole_run() -> None:
    def work(node: str) -> Outcome:
        raise InputError("secret env:MESH_KEY is not set")

    with pytest.raises(InputError):
        run(NODES, work, parallel=2)


def test_every_node_emits_started_and_finished_events() -> None:
    events: list[Event] = []
    run(NODES[:2], done, parallel=1, observer=events.append)
    assert [(event.kind, event.node) for event in events] == [
        (kind, node) for node in NODES[:2] for kind in (EventKind.STARTED, EventKind.FINISHED)
    ]


def test_totals_distinguish_good_unreachable_and_failed_nodes() -> None:
    good = totals([done("a"), Outcome("b", Result.UNCHANGED)])
    away = totals([done("a"), Outcome("b", Result.UNREACHABLE)])
    bad = totals([Outcome("a", Result.ROLLED_BACK), Outcome("b", Result.UNREACHABLE)])
    assert (good.all_good, good.none_reached) == (True, False)
    assert (away.all_good, away.none_reached) == (False, True)
    assert (bad.all_good, bad.none_reached) == (False, False)
    assert str(bad) == "1 rolled back, 1 unreachable"
    assert str(totals([])) == "no node"
