"""Progress of a run: live lines per active node on a terminal, plain lines elsewhere, JSON lines for scripts.

Each class observes `meshctl.fleet` events and is thread-safe; `ThreadedProgress` writes from its own thread.
"""

from __future__ import annotations

import json
import queue
import sys
import threading
from collections import Counter
from contextlib import AbstractContextManager, suppress
from types import TracebackType
from typing import Protocol, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from meshctl import event_log
from meshctl.fleet import Event, EventKind, Outcome, Result
from meshctl.report.terminal_escapes import clean, json_safe, one_line
from meshctl.wording import counted

_STYLES = {
    Result.DONE: "green",
    Result.UNCHANGED: "dim",
    Result.ROLLED_BACK: "yellow",
    Result.FAILED: "red",
    Result.UNREACHABLE: "red",
    Result.PENDING: "dim",
    Result.REFUSED: "yellow",
    Result.UNCERTAIN: "bold red",
}
# Smooth enough, at little CPU time.
REFRESH_PER_SECOND = 4
# the totals, the stop message (up to two lines), and the cursor line
_LINES_BELOW = 5
_MAX_NAMES = 4


class RunProgress(AbstractContextManager["RunProgress"], Protocol):
    """Shows events within its context."""

    def __call__(self, event: Event) -> None: ...

    def stopping(self, text: str) -> None:
        """Show that a stop was requested; `text` explains it. May be called from a signal handler."""


def outcome_text(outcome: Outcome) -> str:
    """`b03: rolled back: no neighbor came back (12.3 s)`."""
    took = f" ({outcome.duration_s:.1f} s)" if outcome.duration_s else ""
    return f"{outcome}{took}"


def _write_error(text: str) -> None:
    # the terminal may be closed, but the work must be finished
    with suppress(OSError):
        sys.stderr.write(f"{clean(text)}\n")
        sys.stderr.flush()


class _LineProgress(RunProgress):
    """Lines written to a stream, for logs, pipes and scripts; stop messages go to standard error."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._lock = threading.Lock()

    def stopping(self, text: str) -> None:
        _write_error(text)

    def _write(self, line: str) -> None:
        with self._lock:
            self._out.write(f"{line}\n")
            self._out.flush()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return


class PlainProgress(_LineProgress):
    """One line per step and outcome."""

    def __call__(self, event: Event) -> None:
        if text := _line(event):
            self._write(text)


def _line(event: Event) -> str:
    """The sanitized line; further lines are indented so that none looks like another node's."""
    return clean(_raw_line(event)).replace("\n", "\n  ")


def _raw_line(event: Event) -> str:
    match event.kind:
        case EventKind.STARTED | EventKind.PROGRESS:
            return ""
        case EventKind.STEP:
            return f"{event.node}: {event.text}"
        case EventKind.NOTE:
            return f"{event.node}: {event.text}" if event.node else event.text
        case EventKind.FINISHED:
            if event.outcome is None:
                return ""
            hint = f"\nhint: {event.outcome.hint}" if event.outcome.hint else ""
            return outcome_text(event.outcome) + hint


class JsonProgress(_LineProgress):
    """One JSON object per event: `{"event", "node", "at_s", ...}`."""

    def __call__(self, event: Event) -> None:
        line: dict[str, object] = {"event": event.kind.value, "node": event.node, "at_s": round(event.at_s, 3)}
        if event.text:
            line["text"] = event.text
        if event.fraction is not None:
            line["fraction"] = round(event.fraction, 3)
        if event.outcome is not None:
            line["outcome"] = outcome_object(event.outcome)
        self._write(json_safe(json.dumps(line, ensure_ascii=False)))


def outcome_object(outcome: Outcome) -> dict[str, object]:
    """An outcome as JSON."""
    return {
        "node": outcome.node,
        "result": outcome.result.value,
        "reason": outcome.reason,
        "hint": outcome.hint,
        "duration_s": outcome.duration_s,
        "facts": dict(outcome.facts),
    }


class LiveProgress(RunProgress):
    """One live line per active node, with outcomes scrolling above and totals below."""

    def __init__(self, console: Console, total: int) -> None:
        self._total = total
        self._lock = threading.Lock()
        self._active: dict[str, tuple[str, float | None]] = {}
        self._counts: Counter[Result] = Counter()
        self._stopping = ""
        self._live = Live(console=console, refresh_per_second=REFRESH_PER_SECOND, transient=True)

    def __enter__(self) -> LiveProgress:
        self._live.__enter__()
        # rich hides the cursor, and nothing would show it again while Ctrl-Z has stopped the process
        self._live.console.show_cursor(True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def __call__(self, event: Event) -> None:
        with self._lock:
            match event.kind:
                case EventKind.STARTED:
                    self._active[event.node] = ("", None)
                case EventKind.STEP:
                    self._active[event.node] = (event.text, None)
                case EventKind.PROGRESS:
                    text, _ = self._active.get(event.node, ("", None))
                    self._active[event.node] = (text, event.fraction)
                case EventKind.NOTE:
                    self._live.console.print(Text(_line(event), "yellow"))
                case EventKind.FINISHED:
                    self._active.pop(event.node, None)
                    if event.outcome is not None:
                        self._counts[event.outcome.result] += 1
                        self._live.console.print(Text(_line(event), _STYLES[event.outcome.result]))
            self._live.update(self._render())

    def stopping(self, text: str) -> None:
        with self._lock:
            # stays on the screen after the live lines
            self._live.console.print(Text(clean(text), "bold yellow"))
            self._stopping = text.partition(":")[0]
            self._live.update(self._render(), refresh=True)

    def _render(self) -> Group:
        width = max((len(name) for name in self._active), default=0)
        lines = [
            Text(f"{name:<{width}}  {one_line(text)}" + (f" {fraction:.0%}" if fraction is not None else ""))
            for name, (text, fraction) in self._active.items()
        ]
        # overflow would cut off the bottom lines: the totals and the stop message
        room = max(1, self._live.console.height - _LINES_BELOW)
        if len(lines) > room:
            lines = [*lines[: room - 1], Text(f"... and {len(lines) - room + 1} more in progress")]
        ended = sum(self._counts.values())
        counts = ", ".join(f"{self._counts[result]} {result.value}" for result in Result if self._counts[result])
        totals = Text(f"{ended}/{counted(self._total, 'node')}" + (f": {counts}" if counts else ""), "bold")
        if not self._stopping:
            return Group(*lines, totals)
        names = ", ".join(list(self._active)[:_MAX_NAMES]) + (" ..." if len(self._active) > _MAX_NAMES else "")
        doing = "no node in progress; no other node will be started"
        if names and self._stopping == "leaving":
            doing = f"disconnecting from {names}; unconfirmed changes roll back by themselves"
        elif names:
            doing = f"finishing {names}; no other node will be started"
        return Group(*lines, totals, Text(f"{self._stopping.upper()}: {doing}", "bold yellow"))


class ThreadedProgress(RunProgress):
    """Shows events from its own thread, so that no node waits for the terminal.

    A blocked reader (a pager, Ctrl-S) blocks only the output, and a closed one (`| head`) only ends it. Otherwise an
    armed change could time out, or its worker fail on the write.
    """

    def __init__(self, shown: RunProgress) -> None:
        self._shown = shown
        self._events: queue.SimpleQueue[Event | str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._show, name="progress", daemon=True)

    def __enter__(self) -> ThreadedProgress:
        self._shown.__enter__()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._events.put(None)
        self._thread.join()
        with suppress(*_READER_GONE):
            self._shown.__exit__(kind, error, trace)

    def __call__(self, event: Event) -> None:
        if event.kind is not EventKind.PROGRESS:
            outcome = event.outcome
            result = None if outcome is None else outcome.result.value
            text = (event.text if outcome is None else outcome.reason) or None
            event_log.emit(event_log.INFO, event.kind.value, node=event.node or None, result=result, text=text)
        self._events.put(event)

    def stopping(self, text: str) -> None:
        self._events.put(text)

    def _show(self) -> None:
        with suppress(*_READER_GONE):
            while (event := self._events.get()) is not None:
                if isinstance(event, str):
                    self._shown.stopping(event)
                else:
                    self._shown(event)


# EPIPE and EIO; rich turns the former into SystemExit
_READER_GONE = (OSError, SystemExit)
