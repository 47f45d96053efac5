"""All devices are queried in parallel, and none affects the others."""

from __future__ import annotations

import threading

import pytest

from meshctl.cli.live_screen import page
from meshctl.errors import NodeError, Unreachable
from meshctl.status.collect import run_parallel


def refuse() -> object:
    raise NodeError("no")


def vanish() -> object:
    raise Unreachable("no answer")


def test_answers_and_errors_are_returned_in_query_order() -> None:
    progress: list[tuple[int, int]] = []
    jobs = {"a": lambda: 1, "b": refuse, "c": vanish, "d": lambda: None}
    found = run_parallel(jobs, 2, lambda done, count: progress.append((done, count)))
    assert list(found) == ["a", "b", "c", "d"]
    assert (found["a"], found["d"]) == (1, None)
    assert isinstance(found["b"], NodeError)
    assert isinstance(found["c"], Unreachable)
    assert progress == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_unexpected_exceptions_propagate_to_the_caller() -> None:
    with pytest.raises(ZeroDivisionError):
        run_parallel({"a": lambda: 1 // 0}, 1)


def test_without_devices_the_result_is_empty() -> None:
    assert run_parallel({}, 8) == {}


def test_stalled_queries_do_not_block_the_others() -> None:
    """With one at a time, and everyone waiting for the last: only those asked beside the silent can let it end."""
    barrier = threading.Barrier(12)
    found = run_parallel(dict.fromkeys(range(12), barrier.wait), 1, stall_timeout_s=0.001)
    assert sorted(str(place) for place in found.values()) == sorted(str(place) for place in range(12))


def test_concurrent_queries_stay_within_the_limit_while_answers_arrive() -> None:
    running, most, lock = 0, 0, threading.Lock()

    def work() -> None:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        with lock:
            running -= 1

    run_parallel(dict.fromkeys(range(200), work), 4, stall_timeout_s=3600)
    assert most <= 4


@pytest.mark.parametrize("height", [1, 2, 5, 24])
def test_a_page_has_no_more_lines_than_the_window(height: int) -> None:
    lines = [f"line {number}" for number in range(10)]
    drawn = page(lines, height)
    assert drawn.count("\n") + 1 == min(height, 10)
    if height < 10:
        assert f"{10 - height + 1} more lines" in drawn
    assert drawn.startswith("\x1b[H")
    assert drawn.endswith("\x1b[K\x1b[J")
