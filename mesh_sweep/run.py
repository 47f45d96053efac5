"""Runs cases on workers: submits, waits, opens another pool after one broke, and gives each case its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait

from mesh_sweep.cases import Case
from mesh_sweep.dispatch import MAX_LONE_DEATHS, Dispatch
from mesh_sweep.errors import CONTINUE, SweepError
from mesh_sweep.executors import Workers
from mesh_sweep.results import Figures, Result

RunCase = Callable[[Case], Figures]
"""Simulates one case; picklable, because it runs on a worker."""
_MAX_REASON = 300
_TICK_S = 1.0
_MAX_BROKEN = 8
"""Pools that broke before any case ended: the fault is not a case's."""


def run_cases(
    cases: Sequence[Case], run: RunCase, workers: Workers, tick: Callable[[], None] = lambda: None
) -> Iterator[Result]:
    """The results, in the order in which cases end. `tick` is called about once a second.

    Closing the iterator, or an exception in the caller, ends the workers at once. Raises SweepError when nothing can
    run: no executor, workers without this package or with another revision.
    """
    if not cases:
        return
    dispatch = Dispatch(cases)
    executor = workers.open()
    running: dict[Future[Figures], Case] = {}
    is_complete = False
    broken = ended = 0
    try:
        while not dispatch.is_finished:
            is_broken = not _submit(dispatch, run, executor, workers, running)
            done, _ = wait(running, timeout=0.0 if is_broken else _TICK_S, return_when=FIRST_COMPLETED)
            tick()
            if is_broken or any(
                isinstance(future.exception(), BrokenExecutor) for future in done if not future.cancelled()
            ):
                # every future of a broken pool ends at once
                done = wait(running).done
                is_broken = True
            dead = []
            for future in done:
                case = running.pop(future)
                try:
                    figures = future.result()
                except Exception as error:  # noqa: BLE001 - whatever a case raises is its result
                    if workers.is_death(error):
                        dead.append(case)
                        continue
                    dispatch.done(case)
                    ended += 1
                    yield Result(case, failed=_reason(error))
                else:
                    dispatch.done(case)
                    ended += 1
                    yield Result(case, figures)
            for case in dispatch.died(dead) if dead else ():
                ended += 1
                yield Result(case, failed=f"killed its worker {MAX_LONE_DEATHS} times while nothing else ran")
            if is_broken:
                broken += 1
                if broken >= _MAX_BROKEN and not ended:
                    raise SweepError(
                        f"workers died {broken} times before any case ended; run one case alone to see why"
                    )
                workers.close(executor, now=True)
                executor = workers.open()
        is_complete = True
    finally:
        workers.close(executor, now=not is_complete)


def _submit(
    dispatch: Dispatch, run: RunCase, executor: Executor, workers: Workers, running: dict[Future[Figures], Case]
) -> bool:
    """Submit what the workers can take; False if the pool is broken."""
    for case in dispatch.take(workers.width()):
        try:
            running[executor.submit(run, case)] = case
        except BrokenExecutor as error:
            lost: Future[Figures] = Future()
            lost.set_exception(error)
            running[lost] = case
    return not any(
        future.done() and isinstance(future.exception(), BrokenExecutor) for future in running if not future.cancelled()
    )


def _reason(error: BaseException) -> str:
    """Why this case has no figures. Raises SweepError for what would happen to every case."""
    if isinstance(error, SweepError):
        raise error
    if isinstance(error, ImportError):
        raise SweepError(
            f"workers cannot import what they need ({error}): install the same version of meshctl-fleet on each of them"
        ) from error
    if isinstance(error, CancelledError):
        raise SweepError(f"the executor canceled a case: is its scheduler still running? {CONTINUE}") from error
    return f"{type(error).__name__}: {error}"[:_MAX_REASON]
