"""A block with a deadline, after which something is done from another thread."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def deadline(seconds: float, act: Callable[[], object]) -> Iterator[None]:
    """Call `act` in another thread if this block takes longer. After the block, `act` has ended, or never runs."""
    timer = threading.Timer(seconds, act)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        # canceling does not stop a timer that has just fired, which would act on what is done next
        timer.cancel()
        timer.join()
