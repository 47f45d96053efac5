"""Run a function for every node, one outcome per node.

`run` works on at most `parallel` nodes at a time, in the given order. A node's error becomes its outcome. When the
failure budget is exhausted or an interrupt is requested, nodes that have not started end as PENDING; the others finish.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import replace

from meshctl.errors import MeshctlError, NodeError, Unreachable
from meshctl.fleet.events import Event, EventKind, Observer, silent
from meshctl.fleet.interrupt import Interrupt
from meshctl.fleet.outcome import Outcome, Result
from meshctl.wording import counted


class FailureBudget:
    """Counts failures over the whole run, across stages; a limit of 0 never stops."""

    def __init__(self, limit: int) -> None:
        if limit < 0:
            raise ValueError(f"stop_after_failures {limit} is negative")
        self._limit = limit
        self._failures = 0
        self._lock = threading.Lock()

    def count(self, outcome: Outcome) -> None:
        if outcome.result.is_failure:
            with self._lock:
                self._failures += 1

    @property
    def is_exhausted(self) -> bool:
        return 0 < self._limit <= self._failures

    @property
    def reason(self) -> str:
        return f"stopped after {counted(self._failures, 'failed node')}"


def outcome_of_error(node: str, error: MeshctlError) -> Outcome:
    """The outcome of a node whose work raised before it was changed."""
    result = Result.UNREACHABLE if isinstance(error, Unreachable) else Result.FAILED
    return Outcome(node, result, str(error), hint=error.hint)


def run(
    nodes: Iterable[str],
    work: Callable[[str], Outcome],
    *,
    parallel: int,
    budget: FailureBudget | None = None,
    interrupt: Interrupt | None = None,
    observer: Observer = silent,
) -> dict[str, Outcome]:
    """Work on every node; returns the outcomes in the given order.

    `work` runs in threads; its NodeError becomes an outcome. Any other exception is a bug, and is raised once the nodes
    in progress have finished. Raises ValueError when `parallel` is below 1.
    """
    if parallel < 1:
        raise ValueError(f"parallel {parallel} is below 1")
    waiting = list(dict.fromkeys(nodes))
    order = tuple(waiting)
    failure_budget = budget or FailureBudget(0)
    signal = interrupt or Interrupt()
    outcomes: dict[str, Outcome] = {}
    in_work: dict[Future[Outcome], str] = {}
    bugs: list[BaseException] = []

    def run_node(node: str) -> Outcome:
        began = time.monotonic()
        observer(Event(EventKind.STARTED, node, time.time()))
        try:
            outcome = work(node)
        except NodeError as error:
            outcome = outcome_of_error(node, error)
        outcome = replace(outcome, duration_s=round(time.monotonic() - began, 3))
        failure_budget.count(outcome)
        observer(Event(EventKind.FINISHED, node, time.time(), outcome.reason, outcome=outcome))
        return outcome

    with ThreadPoolExecutor(max_workers=parallel, thread_name_prefix="node") as pool:
        while waiting or in_work:
            while waiting and len(in_work) < parallel and not (signal.stopping or failure_budget.is_exhausted or bugs):
                node = waiting.pop(0)
                in_work[pool.submit(run_node, node)] = node
            if not in_work:
                break
            finished, _ = wait(in_work, return_when=FIRST_COMPLETED)
            for future in finished:
                node = in_work.pop(future)
                failure = future.exception()
                if failure is not None:
                    bugs.append(failure)
                else:
                    outcomes[node] = future.result()
    if bugs:
        raise bugs[0]
    why = "interrupted before it started" if signal.stopping else failure_budget.reason
    for node in waiting:
        outcomes[node] = Outcome(node, Result.PENDING, why)
        observer(Event(EventKind.FINISHED, node, time.time(), why, outcome=outcomes[node]))
    return {node: outcomes[node] for node in order}
