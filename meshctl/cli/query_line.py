"""The line that shows, while a plan is made, how many nodes were queried and which ones are waited for."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from meshctl.cli.output import echo_error, has_transient_line, transient_line
from meshctl.fleet import Event, EventKind
from meshctl.wording import counted

_MAX_NAMES = 4


class QueryLine:
    """An observer. Its line is on standard error, on a terminal only, and erased at the end."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._queried = 0
        # node -> what is being done with it
        self._active: dict[str, str] = {}
        self._is_shown = has_transient_line()

    def __call__(self, event: Event) -> None:
        with self._lock:
            match event.kind:
                case EventKind.STARTED:
                    self._active[event.node] = ""
                case EventKind.STEP:
                    self._active[event.node] = event.text
                    if not self._is_shown:
                        # it takes minutes
                        echo_error(f"{event.node}: {event.text}")
                case EventKind.FINISHED:
                    self._active.pop(event.node, None)
                    self._queried += event.outcome is not None
            self._write(self.text())

    def text(self) -> str:
        """`queried 12 nodes; waiting for b02, b03`."""
        parts = [f"queried {counted(self._queried, 'node')}"]
        waiting = [name for name, step in self._active.items() if not step]
        if waiting:
            more = f" and {len(waiting) - _MAX_NAMES} more" if len(waiting) > _MAX_NAMES else ""
            parts.append(f"waiting for {', '.join(waiting[:_MAX_NAMES])}{more}")
        parts += [f"{name}: {step}" for name, step in self._active.items() if step]
        return "; ".join(parts)

    def print_above(self, text: str) -> None:
        """A line that stays, such as why the command is stopping; may be called from a signal handler."""
        self._write("")
        echo_error(text)

    def erase(self) -> None:
        with self._lock:
            self._write("")

    def _write(self, text: str) -> None:
        if self._is_shown:
            transient_line(text)


@contextmanager
def query_line() -> Iterator[QueryLine]:
    """Erased when the block ends."""
    line = QueryLine()
    try:
        yield line
    finally:
        line.erase()
