"""Standard output when nobody reads it any more: `| head` has seen enough, a terminal was closed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def unheard() -> Iterator[None]:
    """Within this block a write that fails (EPIPE, EIO) is the last that is tried."""
    try:
        yield
        sys.stdout.flush()
    except OSError:
        # keeps the interpreter from trying, and complaining, once more at its exit
        silence = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silence, sys.stdout.fileno())
        os.close(silence)
