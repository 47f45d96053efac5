"""A run while it goes on: one live line per node in work on a terminal, plain lines elsewhere, JSON lines for scripts.

Each class is an observer of `meshctl.fleet` events and guards itself with a lock, since events come from threads;
`Aside` lets one of them write from a thread of its own.
"""

from __future__ import annotations

import json
import queue
import threading
from collections import Counter
from contextlib import AbstractContextManager, suppress
from types import TracebackType
from typing import Protocol, TextIO

from rich.console import Console, Group
from rich.live import Live
from rich.text import Text

from meshctl.fleet import Event, EventKind, Outcome, Result

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
# Often enough to look alive, seldom enough to leave the processor to the work.
REFRESH_PER_SECOND = 4


class Progress(AbstractContextManager["Progress"], Protocol):
    """Shows events between entering and leaving."""

    def __call__(self, event: Event) -> None: ...


def outcome_text(outcome: Outcome) -> str:
    """`b03: rolled back: no neighbour came back (12.3 s)`."""
    took = f" ({outcome.duration_s:.1f} s)" if outcome.duration_s else ""
    return f"{outcome}{took}"


class PlainProgress(Progress):
    """One line per step and outcome, for logs and pipes."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._lock = threading.Lock()

    def __call__(self, event: Event) -> None:
        text = _line(event)
        if text:
            with self._lock:
                self._out.write(f"{text}\n")
                self._out.flush()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return


def _line(event: Event) -> str:
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
            hint = f"\n  hint: {event.outcome.hint}" if event.outcome.hint else ""
            return outcome_text(event.outcome) + hint


class JsonProgress(Progress):
    """One JSON object per event: `{"event", "node", "at_s", ...}`."""

    def __init__(self, out: TextIO) -> None:
        self._out = out
        self._lock = threading.Lock()

    def __call__(self, event: Event) -> None:
        told: dict[str, object] = {"event": event.kind.value, "node": event.node, "at_s": round(event.at_s, 3)}
        if event.text:
            told["text"] = event.text
        if event.fraction is not None:
            told["fraction"] = round(event.fraction, 3)
        if event.outcome is not None:
            told["outcome"] = outcome_object(event.outcome)
        with self._lock:
            self._out.write(json.dumps(told, ensure_ascii=False) + "\n")
            self._out.flush()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return


def outcome_object(outcome: Outcome) -> dict[str, object]:
    """An outcome for JSON."""
    return {
        "node": outcome.node,
        "result": outcome.result.value,
        "reason": outcome.reason,
        "hint": outcome.hint,
        "duration_s": outcome.duration_s,
        "facts": dict(outcome.facts),
    }


class LiveProgress(Progress):
    """A line per node in work that changes in place, with outcomes scrolling above and totals below."""

    def __init__(self, console: Console, total: int) -> None:
        self._total = total
        self._lock = threading.Lock()
        self._in_work: dict[str, tuple[str, float | None]] = {}
        self._counts: Counter[Result] = Counter()
        self._live = Live(console=console, refresh_per_second=REFRESH_PER_SECOND, transient=True)

    def __enter__(self) -> LiveProgress:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)

    def __call__(self, event: Event) -> None:
        with self._lock:
            match event.kind:
                case EventKind.STARTED:
                    self._in_work[event.node] = ("", None)
                case EventKind.STEP:
                    self._in_work[event.node] = (event.text, None)
                case EventKind.PROGRESS:
                    text, _ = self._in_work.get(event.node, ("", None))
                    self._in_work[event.node] = (text, event.fraction)
                case EventKind.NOTE:
                    self._live.console.print(Text(_line(event), "yellow"))
                case EventKind.FINISHED:
                    self._in_work.pop(event.node, None)
                    if event.outcome is not None:
                        self._counts[event.outcome.result] += 1
                        self._live.console.print(Text(_line(event), _STYLES[event.outcome.result]))
            self._live.update(self._picture())

    def _picture(self) -> Group:
        width = max((len(name) for name in self._in_work), default=0)
        lines = [
            Text(f"{name:<{width}}  {text}" + (f" {fraction:.0%}" if fraction is not None else ""))
            for name, (text, fraction) in self._in_work.items()
        ]
        ended = sum(self._counts.values())
        counts = ", ".join(f"{self._counts[result]} {result.value}" for result in Result if self._counts[result])
        return Group(*lines, Text(f"{ended}/{self._total} nodes" + (f": {counts}" if counts else ""), "bold"))


class Aside(Progress):
    """Shows events from a thread of its own, so that no node's work waits for a screen.

    A reader that stands still (a pager, Ctrl-S) holds up nothing but the lines; one that is gone (a closed terminal,
    `| head`) only ends them. An armed change would run out meanwhile, or its worker die of the failed write.
    """

    def __init__(self, shown: Progress) -> None:
        self._shown = shown
        self._events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._show, name="progress", daemon=True)

    def __enter__(self) -> Aside:
        self._shown.__enter__()
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._events.put(None)
        self._thread.join()
        with suppress(*_UNREAD):
            self._shown.__exit__(kind, error, trace)

    def __call__(self, event: Event) -> None:
        self._events.put(event)

    def _show(self) -> None:
        with suppress(*_UNREAD):
            while (event := self._events.get()) is not None:
                self._shown(event)


# EPIPE and EIO; rich makes SystemExit of the former
_UNREAD = (OSError, SystemExit)
