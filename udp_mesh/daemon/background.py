"""The thread in which the node's long computations run, so that its loop sends and receives meanwhile."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

log = logging.getLogger(__name__)


class BackgroundThread:
    """A `Background` (udp_mesh/core/interfaces.py). `wake` is called on the loop after each work."""

    def __init__(self, loop: asyncio.AbstractEventLoop, wake: Callable[[], None]) -> None:
        self._loop = loop
        self._wake = wake
        # One: a second one would take processor time from the loop. It is started by the first work.
        self._threads = ThreadPoolExecutor(max_workers=1, thread_name_prefix="background")

    def __call__(self, work: Callable[[], None]) -> Callable[[], bool]:
        future = self._threads.submit(work)
        future.add_done_callback(self._done)
        return future.done

    def close(self) -> None:
        """Calls that have not begun are dropped; a running one ends by itself."""
        self._threads.shutdown(wait=False, cancel_futures=True)

    def _done(self, future: Future[None]) -> None:
        if not future.cancelled() and (error := future.exception()) is not None:
            log.error("background-failed error=%r", error)
        # The loop may be closed already.
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._wake)
