"""Wakes every open event stream of the server when a frame or an alarm is new, from any thread."""

from __future__ import annotations

import asyncio
import contextlib
import threading


class Feed:
    """`notify` and `close` may be called from any thread; `wait` runs in the server's event loop."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: set[asyncio.Event] = set()
        self.is_closed = False

    def notify(self) -> None:
        with self._lock:
            loop = self._loop
        if loop is not None:
            # the loop ends between this line and the last one when the server stops
            with contextlib.suppress(RuntimeError):
                loop.call_soon_threadsafe(self._wake)

    def close(self) -> None:
        """End all streams."""
        self.is_closed = True
        self.notify()

    def _wake(self) -> None:
        for event in self._waiting:
            event.set()

    async def wait(self, timeout_s: float) -> None:
        """Until the next `notify`, at most `timeout_s`: another process may write the same history."""
        if self.is_closed:
            return
        with self._lock:
            self._loop = asyncio.get_running_loop()
        event = asyncio.Event()
        self._waiting.add(event)
        try:
            async with asyncio.timeout(timeout_s):
                await event.wait()
        except TimeoutError:
            return
        finally:
            self._waiting.discard(event)
