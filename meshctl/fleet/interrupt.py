"""Ctrl-C as a value that work can look at.

The first one stops taking up new nodes and lets those in work come to their end (a change that is armed is confirmed
or undone within seconds). The second one leaves as soon as waits end that cannot be cut short: what is armed goes back
by itself, the journal says so. The third one ends the process where it stands, which nodes and journal survive as they
survive its death. A terminal that is closed counts as one.
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
        """Ask once to stop, twice to leave."""
        if self._stop.is_set():
            self._leave.set()
            self._report(
                "leaving: what is armed on a node goes back by itself; `meshctl resume` takes it up again "
                "(a third time to end without waiting for any connection)"
            )
        else:
            self._stop.set()
            self._report("stopping: finishing the nodes in work, taking up no more (again to leave at once)")

    def _report(self, text: str) -> None:
        # whoever closed the terminal hears nothing more, and the work still has to come to its end
        with suppress(OSError):
            self._say(text)

    def wait(self, timeout_s: float) -> bool:
        """Sleep until the second request, at most `timeout_s`; True when it came."""
        return self._leave.wait(timeout_s)

    @contextmanager
    def on_signals(self, say: Callable[[str], None]) -> Iterator[None]:
        """Within this block SIGINT, SIGTERM and SIGHUP are requests. Only in the main thread."""
        self._say = say

        def handle(number: int, frame: FrameType | None) -> None:
            if number == signal.SIGHUP and self.stopping:
                # a closed terminal's shell says it once more
                return
            if self.leaving:
                _end()
            self.request()

        # nohup has it ignored, and means it
        hangup = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
        previous = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM, *hangup)}
        try:
            yield
        finally:
            for number, handler in previous.items():
                signal.signal(number, handler)


def _end() -> NoReturn:
    """Without waiting for threads, some of which wait for sockets; live lines have hidden the cursor."""
    with suppress(OSError):
        os.write(2, b"\x1b[?25hended\n" if os.isatty(2) else b"ended\n")
    os._exit(ENDED)
