"""Cases on real executors: a dead worker loses nothing, and a case that kills workers is named."""

from __future__ import annotations

import multiprocessing
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from mesh_sweep import executors
from mesh_sweep.cases import Case
from mesh_sweep.errors import SweepError
from mesh_sweep.executors import DaskWorkers, OtherWorkers, ProcessWorkers
from mesh_sweep.results import Identity, encode_all
from mesh_sweep.run import run_cases
from tests.mesh_sweep import sample

OURS = Identity("mine", "0" * 16, "1")
CASES = [Case((("a", "1"),), seed) for seed in range(1, 11)]
INLINE = OtherWorkers("tests.mesh_sweep.sample:InlineExecutor", 2)


def test_workers_that_die_lose_nothing_and_the_case_that_kills_them_is_named(tmp_path: Path) -> None:
    results = {
        one.case.seed: one for one in run_cases(CASES, partial(sample.troubled, str(tmp_path)), ProcessWorkers(2))
    }
    assert sorted(results) == list(range(1, 11))
    assert {seed: one.failed for seed, one in results.items() if one.failed} == {
        3: "killed its worker 2 times while nothing else ran",
        7: "ZeroDivisionError: seven",
    }
    assert results[5].figures == sample.double(results[5].case)


def test_every_executor_gives_the_same_bytes() -> None:
    expected = encode_all(OURS, run_cases(CASES, sample.double, INLINE))
    threads = OtherWorkers("concurrent.futures:ThreadPoolExecutor", 2)
    assert encode_all(OURS, run_cases(CASES, sample.double, threads)) == expected
    assert encode_all(OURS, run_cases(CASES, sample.double, ProcessWorkers(2))) == expected
    assert expected.count(b"\n") == len(CASES)
    assert isinstance(threads.open(), ThreadPoolExecutor)


def test_a_sweep_that_is_stopped_leaves_no_worker() -> None:
    results = run_cases(CASES, sample.double, ProcessWorkers(2))
    next(results)
    results.close()  # type: ignore[attr-defined]
    for process in multiprocessing.active_children():
        process.join(10)
    assert multiprocessing.active_children() == []


def test_workers_that_never_start_stop_the_sweep() -> None:
    dead = OtherWorkers("tests.mesh_sweep.sample:DeadExecutor", 64)
    with pytest.raises(SweepError, match="workers died 8 times before any case ended"):
        list(run_cases([Case((), seed) for seed in range(1000)], sample.double, dead))


@pytest.mark.parametrize(
    ("run", "problem"),
    [(sample.other_revision, "expected workers with revision a, found one with b"), (sample.not_installed, "install")],
)
def test_workers_of_another_version_stop_the_sweep(run: object, problem: str) -> None:
    with pytest.raises(SweepError, match=problem):
        list(run_cases(CASES, run, INLINE))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("nowhere:Executor", "expected MODULE:CALLABLE, found 'nowhere:Executor': No module named 'nowhere'"),
        ("math", "expected MODULE:CALLABLE"),
        ("builtins:dict", "expected a concurrent.futures.Executor from builtins:dict, found dict"),
    ],
)
def test_what_is_no_executor_is_reported(name: str, problem: str) -> None:
    with pytest.raises(SweepError, match=problem):
        OtherWorkers(name, 1).open()


def test_an_invalid_scheduler_address_is_reported() -> None:
    with pytest.raises(SweepError, match="--dask: expected a Dask scheduler at nowhere://x:1, found none: "):
        DaskWorkers("nowhere://x:1").open()
    # without a traceback half a minute later
    with pytest.raises(SweepError, match=r"--dask: expected an address such as tcp://host:8786, .* found 'cluster'"):
        DaskWorkers("cluster").open()
    with pytest.raises(SweepError, match="--dask tls://x:1: expected certificates for TLS in Dask's configuration"):
        DaskWorkers("tls://x:1").open()


def test_a_scheduler_file_that_does_not_come_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "_FILE_POLLS", 2)
    half = tmp_path / "half.json"
    half.write_text('{"type": "Sched')
    for file in (half, tmp_path / "none.json"):
        with pytest.raises(SweepError, match=f"--dask {file}: expected the file of a Dask scheduler, found none"):
            DaskWorkers(str(file)).open()
