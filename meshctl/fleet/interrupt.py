"""Ctrl-C as a value that running work checks.

The first one stops starting new nodes and lets those in progress finish (an armed change is confirmed or rolled back
within seconds). The second one exits as soon as waits that cannot be interrupted end: armed changes roll back by
themselves, and the journal has them as uncertain. The third one ends the process at once, which nodes and journal
survive like a crash. A closed terminal counts as one.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import NoReturn

# 128 + SIGINT, as shells report it
ENDED = 130


class Interrupt:
    """`stopping` after the first signal, `leaving` after the second; both stay set."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._leave = threading.Event()
        self._say: Callable[[str], None] = lambda text: None

    @property
    def stopping(self) -> bool:
        return self._stop.is_set()

    @property
    def leaving(self) -> bool:
        return self._leave.is_set()

    def request(self) -> None:
        """Request once to stop, twice to leave."""
        if self._stop.is_set():
            self._leave.set()
            # how to go on depends on the command: its last line says so
            self._report(
                "leaving: nodes roll back what is not confirmed (Ctrl-C again to exit without closing connections)"
            )
        else:
            self._stop.set()
            self._report("stopping: finishing the nodes in progress, starting no more (Ctrl-C again to leave now)")

    def _report(self, text: str) -> None:
        # the terminal may be closed, and the work still has to finish
        with suppress(OSError):
            self._say(text)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until the second request, at most `timeout_s`; True when it came."""
        return self._leave.wait(timeout_s)

    @contextmanager
    def on_signals(self, say: Callable[[str], None], *, is_only_reading: bool = False) -> Iterator[None]:
        """Within this block SIGINT, SIGTERM and SIGHUP are requests; where nothing is changed, the second one ends the
        process instead. Only in the main thread."""
        self._say = say

        def handle(number: int, frame: FrameType | None) -> None:
            if number == signal.SIGHUP and self.stopping:
                # the shell of a closed terminal sends a second SIGHUP
                return
            if self.leaving or (is_only_reading and self.stopping):
                _end()
            self.request()

        # keep SIGHUP ignored under nohup
        hangup = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
        previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM, *hangup)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def _end() -> NoReturn:
    """Exit without waiting for threads, which may wait for sockets, and show the cursor that live lines have hidden."""
    with suppress(OSError):
        os.write(2, b"\x1b[?25hended\n" if os.isatty(2) else b"ended\n")
    os._exit(ENDED)
