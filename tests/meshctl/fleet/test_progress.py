"""The output of a run: plain lines, JSON lines, and live lines that never hide an outcome."""

from __future__ import annotations

import io
import json
import threading

import pytest
from rich.console import Console

from meshctl.fleet import Event, EventKind, Outcome, Result
from meshctl.report.progress import JsonProgress, LiveProgress, PlainProgress, ThreadedProgress

GONE = Outcome("b01", Result.ROLLED_BACK, "no neighbor came back", hint="look at its antenna", duration_s=12.34)
EVENTS = [
    Event(EventKind.STARTED, "b01", 1.0),
    Event(EventKind.STEP, "b01", 1.1, "stage"),
    Event(EventKind.PROGRESS, "b01", 1.2, fraction=0.5),
    Event(EventKind.NOTE, "", 1.3, "3 nodes change simultaneously"),
    Event(EventKind.FINISHED, "b01", 1.4, GONE.reason, outcome=GONE),
]


def test_plain_lines_show_steps_notes_and_outcomes() -> None:
    out = io.StringIO()
    with PlainProgress(out) as progress:
        for event in EVENTS:
            progress(event)
    assert out.getvalue().splitlines() == [
        "b01: stage",
        "3 nodes change simultaneously",
        "b01: rolled back: no neighbor came back (12.3 s)",
        "  hint: look at its antenna",
    ]


def test_json_lines_hold_every_event() -> None:
    out = io.StringIO()
    with JsonProgress(out) as progress:
        for event in EVENTS:
            progress(event)
    lines = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [line["event"] for line in lines] == ["started", "step", "progress", "note", "finished"]
    assert lines[2]["fraction"] == 0.5
    assert lines[4]["outcome"]["result"] == "rolled back"


def test_live_lines_keep_outcomes_and_count_them() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=100)
    with LiveProgress(console, 2) as progress:
        for event in EVENTS:
            progress(event)
    assert isinstance(console.file, io.StringIO)
    shown = console.file.getvalue()
    assert "b01: rolled back: no neighbor came back (12.3 s)" in shown
    assert "1/2 nodes: 1 rolled back" in shown


def test_live_lines_leave_the_cursor_visible_for_a_shell_that_stops_the_process() -> None:
    out = io.StringIO()
    with LiveProgress(Console(file=out, force_terminal=True, width=100), 2):
        shown = out.getvalue()
    assert shown.rfind("\x1b[?25h") > shown.rfind("\x1b[?25l")


def test_a_blocked_reader_does_not_block_the_run() -> None:
    may_write = threading.Event()

    class Slow(io.StringIO):
        def write(self, text: str) -> int:
            may_write.wait()
            return super().write(text)

    out = Slow()
    with ThreadedProgress(PlainProgress(out)) as progress:
        for event in EVENTS:
            progress(event)
        assert out.getvalue() == ""
        may_write.set()
    assert len(out.getvalue().splitlines()) == 4


def test_a_broken_pipe_stops_the_output_but_not_the_run() -> None:
    class Closed(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError

    for make in (PlainProgress, JsonProgress):
        out = Closed()
        with ThreadedProgress(make(out)) as progress:
            for event in EVENTS:
                progress(event)
        assert out.getvalue() == ""


STOPPING = "stopping: finishing the nodes in progress, starting no more (again to leave at once)"


def test_the_stopping_state_is_shown_with_the_nodes_still_in_progress() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100, height=30)
    with ThreadedProgress(LiveProgress(console, 3)) as progress:
        progress(EVENTS[0])
        progress(Event(EventKind.STARTED, "b02", 1.0))
        progress.stopping(STOPPING)
        progress(EVENTS[-1])
        progress(Event(EventKind.STEP, "b02", 2.0, "confirm"))
    shown = screen.getvalue()
    assert STOPPING in shown, "and stays when the live lines are gone"
    assert "STOPPING: finishing b01, b02; no other node will be started" in shown
    assert "STOPPING: finishing b02; no other node will be started" in shown


def test_a_second_stop_request_replaces_the_displayed_state() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100, height=30)
    with LiveProgress(console, 1) as progress:
        progress(EVENTS[0])
        progress.stopping(STOPPING)
        progress.stopping("leaving: what armed changes roll back by itself")
    assert "LEAVING: disconnecting from b01; unconfirmed changes roll back by themselves" in screen.getvalue()


def test_long_node_lists_are_cut_to_fit_the_totals_and_stopping_state() -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=100, height=12)
    with LiveProgress(console, 40) as progress:
        for number in range(40):
            progress(Event(EventKind.STARTED, f"b{number:02}", 1.0))
        progress.stopping(STOPPING)
    assert "... and 34 more in progress" in screen.getvalue()
    last = screen.getvalue().rpartition("... and 34 more in progress")[2]
    assert "0/40 nodes" in last
    assert "STOPPING: finishing b00, b01, b02, b03 ...; no other node will be started" in last


def test_without_a_terminal_progress_goes_to_standard_error(capsys: pytest.CaptureFixture[str]) -> None:
    for kind in (PlainProgress, JsonProgress):
        out = io.StringIO()
        with kind(out) as progress:
            progress.stopping(STOPPING)
        assert (out.getvalue(), capsys.readouterr().err) == ("", f"{STOPPING}\n")
