"""A full-screen view that is refreshed in the background, until Ctrl-C.

`live_screen` refreshes in a daemon thread and draws in the main thread: on new data, on a window resize, and once a
second, since ages grow. It uses the terminal's alternate screen, so the previous contents come back.

Signal handlers only wake the drawing loop through a pipe: writing to the terminal in a handler could interrupt a write.
"""

from __future__ import annotations

import os
import select
import shutil
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FrameType
from typing import Generic, TextIO, TypeVar

from meshctl.report.terminal_escapes import clean_styled
from meshctl.wording import counted

T = TypeVar("T")

# xterm control sequences: alternate screen, hidden cursor, no line wrapping
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l\x1b[?7l", "\x1b[?7h\x1b[?25h\x1b[?1049l"
_HOME, _END_OF_LINE, _END_OF_PAGE = "\x1b[H", "\x1b[K", "\x1b[J"
_REDRAW_S = 1.0


@dataclass(slots=True)
class _Refresher(Generic[T]):
    """The background thread: keeps the latest value or the failure, and writes to `wakeup_fd` after each."""

    refresh: Callable[[], T]
    period_s: float
    wakeup_fd: int
    latest: T | None = None
    failure: BaseException | None = None
    _end: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        while not self._end.is_set():
            began = time.monotonic()
            try:
                self.latest = self.refresh()
            except BaseException as error:  # noqa: BLE001 - raised again in the main thread
                self.failure = error
            if self._end.is_set():
                return
            _wake(self.wakeup_fd)
            if self.failure is not None:
                return
            self._end.wait(max(0.0, self.period_s - (time.monotonic() - began)))

    def stop(self) -> None:
        self._end.set()


def live_screen(
    refresh: Callable[[], T],
    draw: Callable[[T | None, os.terminal_size], list[str]],
    period_s: float,
    out: TextIO,
    size: Callable[[], os.terminal_size] = shutil.get_terminal_size,
) -> T | None:
    """Draw the value of `refresh` every `period_s` until Ctrl-C; returns the latest value.

    `draw` gets the value (None before the first) and the window size, and returns lines. Raises what `refresh` raises.
    """
    reader, writer = os.pipe2(os.O_NONBLOCK)
    refresher = _Refresher(refresh, period_s, writer)
    thread = threading.Thread(target=refresher.run, name="refresh", daemon=True)
    try:
        with _screen(out, writer) as screen:
            thread.start()
            while refresher.failure is None:
                screen.handle_suspend()
                _draw(draw, refresher.latest, out, size())
                ready, _, _ = select.select([reader], [], [], _REDRAW_S)
                if ready:
                    os.read(reader, 4096)
    except KeyboardInterrupt:
        # the way to quit
        pass
    finally:
        refresher.stop()
        # the pipe stays open: a refresh in progress may still write, and a closed descriptor may be reused
    if refresher.failure is not None:
        raise refresher.failure
    return refresher.latest


def _wake(wakeup_fd: int) -> None:
    try:
        os.write(wakeup_fd, b"!")
    except BlockingIOError:
        # the pipe is full, so the reader wakes up anyway
        return


def _draw(
    draw: Callable[[T | None, os.terminal_size], list[str]], value: T | None, out: TextIO, size: os.terminal_size
) -> None:
    out.write(page(draw(value, size), size.lines))
    out.flush()


def page(lines: list[str], height: int) -> str:
    """The lines as one page of `height`, each clearing the rest of its line."""
    room = max(1, height)
    if len(lines) > room:
        hidden = len(lines) - room + 1
        lines = [*lines[: room - 1], f"... {counted(hidden, 'more line')}: enlarge the window or filter (--alarm any)"]
    lines = [clean_styled(line) for line in lines]
    return _HOME + f"{_END_OF_LINE}\r\n".join(lines) + _END_OF_LINE + _END_OF_PAGE


@dataclass(slots=True)
class _Screen:
    """The alternate screen. `is_suspend_requested`: Ctrl-Z was pressed; `is_resumed`: it must be entered again."""

    out: TextIO
    is_suspend_requested: bool = False
    is_resumed: bool = False

    def enter(self) -> None:
        self.out.write(_ENTER)

    def leave(self) -> None:
        self.out.write(_LEAVE)
        self.out.flush()

    def handle_suspend(self) -> None:
        """Release the terminal while the process is stopped, then enter the alternate screen again."""
        if self.is_suspend_requested:
            self.is_suspend_requested = False
            self.leave()
            handler = signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            # returns on SIGCONT, or at once in an orphaned process group (POSIX.1)
            os.kill(os.getpid(), signal.SIGTSTP)
            signal.signal(signal.SIGTSTP, handler)
            self.is_resumed = True
        if self.is_resumed:
            self.is_resumed = False
            self.enter()


@contextmanager
def _screen(out: TextIO, wakeup_fd: int) -> Iterator[_Screen]:
    """The alternate screen within the block. Signals wake the drawing loop; SIGTERM ends the process."""
    screen = _Screen(out)

    def resized(number: int, frame: FrameType | None) -> None:
        _wake(wakeup_fd)

    def ended(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    def stopped(number: int, frame: FrameType | None) -> None:
        screen.is_suspend_requested = True
        _wake(wakeup_fd)

    def resumed(number: int, frame: FrameType | None) -> None:
        screen.is_resumed = True
        _wake(wakeup_fd)

    handlers = {
        signal.SIGWINCH: resized,
        signal.SIGTERM: ended,
        signal.SIGTSTP: stopped,
        signal.SIGCONT: resumed,
    }
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    screen.enter()
    try:
        yield screen
    finally:
        screen.leave()
        for number, handler in before.items():
            signal.signal(number, handler)
