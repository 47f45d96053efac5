"""What is shown of a run: plain lines, JSON lines, and live lines that never hide an outcome."""

from __future__ import annotations

import io
import json
import threading

from rich.console import Console

from meshctl.fleet import Event, EventKind, Outcome, Result
from meshctl.report.progress import Aside, JsonProgress, LiveProgress, PlainProgress

GONE = Outcome("b01", Result.ROLLED_BACK, "no neighbour came back", hint="look at its antenna", duration_s=12.34)
EVENTS = [
    Event(EventKind.STARTED, "b01", 1.0),
    Event(EventKind.STEP, "b01", 1.1, "stage"),
    Event(EventKind.PROGRESS, "b01", 1.2, fraction=0.5),
    Event(EventKind.NOTE, "", 1.3, "3 nodes change at one moment"),
    Event(EventKind.FINISHED, "b01", 1.4, GONE.reason, outcome=GONE),
]


def test_plain_lines_tell_steps_notes_and_outcomes() -> None:
    out = io.StringIO()
    with PlainProgress(out) as progress:
        for event in EVENTS:
            progress(event)
    assert out.getvalue().splitlines() == [
        "b01: stage",
        "3 nodes change at one moment",
        "b01: rolled back: no neighbour came back (12.3 s)",
        "  hint: look at its antenna",
    ]


def test_json_lines_hold_every_event() -> None:
    out = io.StringIO()
    with JsonProgress(out) as progress:
        for event in EVENTS:
            progress(event)
    told = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [line["event"] for line in told] == ["started", "step", "progress", "note", "finished"]
    assert told[2]["fraction"] == 0.5
    assert told[4]["outcome"]["result"] == "rolled back"


def test_live_lines_keep_outcomes_and_count_them() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with LiveProgress(console, 2) as progress:
        for event in EVENTS:
            progress(event)
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "b01: rolled back: no neighbour came back (12.3 s)" in shown
    assert "1/2 nodes: 1 rolled back" in shown


def test_a_reader_that_stands_still_holds_up_no_work() -> None:
    may_write = threading.Event()

    class Slow(io.StringIO):
        def write(self, text: str) -> int:
            may_write.wait()
            return super().write(text)

    out = Slow()
    with Aside(PlainProgress(out)) as progress:
        for event in EVENTS:
            progress(event)
        assert out.getvalue() == ""
        may_write.set()
    assert len(out.getvalue().splitlines()) == 4


def test_a_reader_that_is_gone_ends_the_lines_and_no_work() -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    for make in (PlainProgress, JsonProgress):
        out = Closed()
        with Aside(make(out)) as progress:
            for event in EVENTS:
                progress(event)
        assert out.getvalue() == ""
