"""Cases for tests of executors: what a worker runs has to be importable there."""

from __future__ import annotations

import os
import signal
from concurrent.futures import BrokenExecutor, Executor, Future
from pathlib import Path
from typing import Any

from mesh_sweep.cases import Case
from mesh_sweep.errors import SweepError


def double(case: Case) -> dict[str, float | None]:
    return {"seed": float(case.seed), "doubled": 2.0 * case.seed, "none": None}


def troubled(directory: str, case: Case) -> dict[str, float | None]:
    """Seed 3 always kills its worker, seed 5 the first time, seed 7 fails by itself."""
    first = Path(directory) / "first"
    if case.seed == 3 or (case.seed == 5 and not first.exists()):
        if case.seed == 5:
            first.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if case.seed == 7:
        raise ZeroDivisionError("seven")
    return double(case)


def other_revision(case: Case) -> dict[str, float | None]:
    raise SweepError("expected workers with revision a, found one with b")


def not_installed(case: Case) -> dict[str, float | None]:
    raise ModuleNotFoundError("No module named 'udp_mesh'")


class DeadExecutor(Executor):
    """A pool whose workers never start."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        raise BrokenExecutor("a process was terminated abruptly")


class InlineExecutor(Executor):
    """Runs each case in `submit`, in this process."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - an executor passes on whatever a call raises
            future.set_exception(error)
        return future
