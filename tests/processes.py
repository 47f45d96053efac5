"""Processes of tests that end with a failed test: `Popen` alone would wait for them, for as long as they run."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def killed_on_failure(process: subprocess.Popen[bytes] | subprocess.Popen[str]) -> Iterator[None]:
    """Kills the process if the block fails; within `with Popen(...) as process`, which then waits for its end."""
    try:
        yield
    except BaseException:
        process.kill()
        raise
