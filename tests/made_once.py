"""What takes long to make and is only read: one of the workers of a run makes it, for all of them."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import pytest


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """The directory `name` of this run, which `make` filled. A worker that comes while another makes it waits.

    `make` gets a directory of another name, which is renamed when it is complete: after a failure the next caller
    starts over.
    """
    base = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        # each worker has a directory of its own below that of the run
        base = base.parent
    made = base / name
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not made.exists():
            directory = factory.mktemp(name)
            make(directory)
            directory.rename(made)
    return made
