"""A page on the terminal that is drawn anew while looks go on in the background, until Ctrl-C.

`live` looks in a daemon thread and draws in the main one: at every answer, at every change of the window's size, and
once a second, since ages grow. The page has the terminal's other screen, so what stood there before comes back.

Signals do nothing themselves but ring the bell that the drawing waits for: a handler that wrote to the terminal could
come in the middle of what is being written.
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

T = TypeVar("T")

# xterm's control sequences: other screen, hidden cursor, no wrapping of long lines
_ENTER, _LEAVE = "\x1b[?1049h\x1b[?25l\x1b[?7l", "\x1b[?7h\x1b[?25h\x1b[?1049l"
_HOME, _END_OF_LINE, _END_OF_PAGE = "\x1b[H", "\x1b[K", "\x1b[J"
_REDRAW_S = 1.0


@dataclass(slots=True)
class _Refresher(Generic[T]):
    """The background's side: the latest value, or what went wrong; `bell` is written to when there is something new."""

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
    take: Callable[[], T],
    draw: Callable[[T | None, os.terminal_size], list[str]],
    period_s: float,
    out: TextIO,
    size: Callable[[], os.terminal_size] = shutil.get_terminal_size,
) -> T | None:
    """Draw what `take` gives every `period_s`, until Ctrl-C; returns the latest. `draw` gets it (None before the first)
    and the window's size, and gives lines. Raises what `take` raises."""
    reader, writer = os.pipe2(os.O_NONBLOCK)
    looks = _Refresher(take, period_s, writer)
    thread = threading.Thread(target=looks.run, name="looks", daemon=True)
    try:
        with _screen(out, writer) as screen:
            thread.start()
            while looks.failure is None:
                screen.handle_suspend()
                _draw(draw, looks.latest, out, size())
                ready, _, _ = select.select([reader], [], [], _REDRAW_S)
                if ready:
                    os.read(reader, 4096)
    except KeyboardInterrupt:
        # the way to leave; what was seen last stays
        pass
    finally:
        looks.stop()
        # the pipe stays open: a look that is still under way may ring, and a closed number may soon be another's
    if looks.failure is not None:
        raise looks.failure
    return looks.latest


def _wake(bell: int) -> None:
    try:
        os.write(bell, b"!")
    except BlockingIOError:
        # it has rung often enough to be heard
        return


def _draw(
    draw: Callable[[T | None, os.terminal_size], list[str]], value: T | None, out: TextIO, size: os.terminal_size
) -> None:
    out.write(page(draw(value, size), size.lines))
    out.flush()


def page(lines: list[str], height: int) -> str:
    """The lines as one page of that height, each clearing what stood there before."""
    room = max(1, height)
    if len(lines) > room:
        hidden = len(lines) - room + 1
        lines = [*lines[: room - 1], f"... {hidden} more lines: enlarge the window, or show less (--alarm any)"]
    lines = [clean_styled(line) for line in lines]
    return _HOME + f"{_END_OF_LINE}\r\n".join(lines) + _END_OF_LINE + _END_OF_PAGE


@dataclass(slots=True)
class _Screen:
    """The terminal's other screen. `is_stopping`: Ctrl-Z was pressed; `is_resumed`: somebody else may have drawn."""

    out: TextIO
    is_suspend_requested: bool = False
    is_resumed: bool = False

    def enter(self) -> None:
        self.out.write(_ENTER)

    def leave(self) -> None:
        self.out.write(_LEAVE)
        self.out.flush()

    def handle_suspend(self) -> None:
        """Gives the terminal back for as long as the process is stopped, and takes it again."""
        if self.is_suspend_requested:
            self.is_suspend_requested = False
            self.leave()
            handler = signal.signal(signal.SIGTSTP, signal.SIG_DFL)
            # returns when somebody lets us go on; at once where nobody could, as in a session of our own (POSIX.1,
            # orphaned process group)
            os.kill(os.getpid(), signal.SIGTSTP)
            signal.signal(signal.SIGTSTP, handler)
            self.is_resumed = True
        if self.is_resumed:
            self.is_resumed = False
            self.enter()


@contextmanager
def _screen(out: TextIO, bell: int) -> Iterator[_Screen]:
    """The other screen, for as long as the block runs. Window changes ring the bell; SIGTERM ends the process."""
    screen = _Screen(out)

    def resized(number: int, frame: FrameType | None) -> None:
        _wake(bell)

    def ended(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    def stopped(number: int, frame: FrameType | None) -> None:
        screen.is_suspend_requested = True
        _wake(bell)

    def resumed(number: int, frame: FrameType | None) -> None:
        screen.is_resumed = True
        _wake(bell)

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
