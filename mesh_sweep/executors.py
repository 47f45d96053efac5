"""Where cases run: processes of this machine, a Dask cluster, or any other `concurrent.futures.Executor`.

A `Workers` opens executors; `run` opens another one after a pool broke. Dask is imported only if it is asked for.
"""

from __future__ import annotations

import importlib
import json
import logging
import multiprocessing
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from mesh_sweep.errors import CONTINUE, SweepError

_CONNECT_S = 15
_FILE_POLL_S, _FILE_POLLS = 0.2, 150
_ADDRESS = re.compile(r"([a-z]+://)?[^/]+:[0-9]+")


class Workers(Protocol):
    def open(self) -> Executor:
        """A new executor. Raises SweepError when there is none."""
        ...

    def width(self) -> int:
        """How many cases to submit at once: enough to keep each worker busy."""
        ...

    def is_death(self, error: BaseException) -> bool:
        """Whether the case lost its worker, rather than failing by itself."""
        ...

    def close(self, executor: Executor, *, now: bool) -> None:
        """End the executor; `now`: without waiting for cases that run."""
        ...


def core_count() -> int:
    """The cores that this process may use: fewer than the machine has in a container or a Slurm job."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(slots=True)
class ProcessWorkers:
    """Processes of this machine."""

    jobs: int
    _others: set[int | None] = field(default_factory=set)

    def open(self) -> Executor:
        self._others = {process.pid for process in multiprocessing.active_children()}
        methods = multiprocessing.get_all_start_methods()
        # children of a small clean process: no threads and no open files are inherited
        method = "forkserver" if "forkserver" in methods else "spawn"
        return ProcessPoolExecutor(self.jobs, multiprocessing.get_context(method), initializer=_start_worker)

    def width(self) -> int:
        # one case more each, so that no worker waits for the next one
        return 2 * self.jobs

    def is_death(self, error: BaseException) -> bool:
        return isinstance(error, BrokenExecutor)

    def close(self, executor: Executor, *, now: bool) -> None:
        executor.shutdown(wait=not now, cancel_futures=True)
        if now:
            # `shutdown` would wait for the cases that run
            for process in multiprocessing.active_children():
                if process.pid not in self._others:
                    process.terminate()


def _start_worker() -> None:
    """Ctrl-C reaches every process of a terminal; the sweep decides what ends. A worker ends with its sweep."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)


@dataclass(slots=True)
class DaskWorkers:
    """The workers of a Dask scheduler, which moves the cases of a dead worker to others by itself.

    `address` is the scheduler's, or the file where it writes it (`dask scheduler --scheduler-file`).
    """

    address: str
    _client: Any = field(default=None)
    _is_waiting: bool = False

    def open(self) -> Executor:
        try:
            import distributed
        except ImportError:
            raise SweepError(
                "--dask: expected the package distributed, found none: pip install 'meshctl-fleet[dask]'"
            ) from None
        if self.address.endswith(".json"):
            self.address = _address_in(Path(self.address))
        if not _ADDRESS.fullmatch(self.address):
            # distributed finds that out too late, and prints a traceback
            raise SweepError(
                "--dask: expected an address such as tcp://host:8786, or the JSON file of `dask scheduler "
                f"--scheduler-file`, found {self.address!r}"
            )
        configured: Any = distributed.Security
        if self.address.startswith("tls:") and configured().get_connection_args("client")["ssl_context"] is None:
            # distributed prints a traceback, and waits for half a minute
            raise SweepError(
                f"--dask {self.address}: expected certificates for TLS in Dask's configuration "
                "(distributed.comm.tls), found none"
            )
        try:
            connect: Any = distributed.Client
            self._client = connect(self.address, timeout=_CONNECT_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise SweepError(
                f"--dask: expected a Dask scheduler at {self.address}, found none: {str(error).splitlines()[0]}"
            ) from None
        # lost connections are reported by the sweep, without a traceback; the client's logger has a level of its own
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        executor: Executor = self._client.get_executor(pure=False)
        return executor

    def width(self) -> int:
        # workers may come and go; two each, and a few for those that join
        try:
            threads = sum(int(count) for count in self._client.nthreads().values())
        except (OSError, RuntimeError, ValueError) as error:
            raise SweepError(f"lost the Dask scheduler at {self.address}: {error}; {CONTINUE}") from error
        if not threads and not self._is_waiting:
            sys.stderr.write(f"{self.address} has no workers: waiting for one\n")
        self._is_waiting = not threads
        return 2 * max(2, threads)

    def is_death(self, error: BaseException) -> bool:
        from distributed import KilledWorker

        return isinstance(error, BrokenExecutor | KilledWorker)

    def close(self, executor: Executor, *, now: bool) -> None:
        # without waiting it cancels what it has, and knows no other option
        executor.shutdown(wait=not now)
        self._client.close()


def _address_in(file: Path) -> str:
    """The scheduler's address; one that was started just before, in the same job, has some seconds to write it."""
    problem: Exception | None = None
    for _ in range(_FILE_POLLS):
        try:
            return str(json.loads(file.read_bytes())["address"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            problem = error
        time.sleep(_FILE_POLL_S)
    raise SweepError(f"--dask {file}: expected the file of a Dask scheduler, found none: {problem}")


@dataclass(slots=True)
class OtherWorkers:
    """An executor of the operator's own: `MODULE:NAME` is called without arguments."""

    name: str
    jobs: int

    def open(self) -> Executor:
        module, _, attribute = self.name.partition(":")
        try:
            make: Callable[[], object] = getattr(importlib.import_module(module), attribute)
            made = make()
        except (ImportError, AttributeError, ValueError, TypeError) as error:
            raise SweepError(f"--executor: expected MODULE:CALLABLE, found {self.name!r}: {error}") from None
        if not isinstance(made, Executor):
            raise SweepError(
                f"--executor: expected a concurrent.futures.Executor from {self.name}, found {type(made).__name__}"
            )
        return made

    def width(self) -> int:
        return 2 * self.jobs

    def is_death(self, error: BaseException) -> bool:
        return isinstance(error, BrokenExecutor)

    def close(self, executor: Executor, *, now: bool) -> None:
        try:
            executor.shutdown(wait=not now, cancel_futures=now)
        except TypeError:
            # older than the option, as several executors are
            executor.shutdown(wait=not now)
