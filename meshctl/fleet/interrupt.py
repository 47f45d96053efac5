"""Ctrl-C as a value that work can look at.

The first one stops taking up new nodes and lets those in work come to their end (a change that is armed is confirmed
or undone within seconds). The second one leaves at once: what is armed goes back by itself, the journal says so.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


class Interrupt:
    """`stopping` after the first signal, `leaving` after the second; both stay set."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._leave = threading.Event()
        self._said: Callable[[str], None] = lambda text: None

    @property
    def stopping(self) -> bool:
        return self._stop.is_set()

    @property
    def leaving(self) -> bool:
        return self._leave.is_set()

    def request(self) -> None:
        """Ask once to stop, twice to leave."""
        if self._stop.is_set():
            self._leave.set()
            self._said("leaving now: what is armed on a node goes back by itself; `meshctl resume` takes it up again")
        else:
            self._stop.set()
            self._said("stopping: finishing the nodes in work, taking up no more (again to leave at once)")

    def wait(self, timeout_s: float) -> bool:
        """Sleep until the second request, at most `timeout_s`; True when it came."""
        return self._leave.wait(timeout_s)

    @contextmanager
    def on_signals(self, say: Callable[[str], None]) -> Iterator[None]:
        """Within this block SIGINT and SIGTERM are requests. Only in the main thread."""
        self._said = say

        def handle(number: int, frame: FrameType | None) -> None:
            self.request()

        previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)
