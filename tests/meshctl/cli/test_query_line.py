"""The line that counts the queried nodes while a plan is made."""

from __future__ import annotations

import io
import sys

import pytest

from meshctl.cli.query_line import query_line
from meshctl.fleet import Event, EventKind, Outcome, Result


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def started(node: str) -> Event:
    return Event(EventKind.STARTED, node, 0.0)


def finished(node: str) -> Event:
    return Event(EventKind.FINISHED, node, 0.0, outcome=Outcome(node, Result.DONE))


def test_the_line_names_the_nodes_that_are_waited_for_and_is_erased(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    with query_line() as line:
        for name in ("b01", "b02", "b03"):
            line(started(name))
        line(finished("b02"))
        assert screen.getvalue().endswith("\r\x1b[Kqueried 1 node; waiting for b01, b03")
        line(Event(EventKind.STEP, "b02", 0.0, "repairs its links"))
        assert screen.getvalue().endswith("queried 1 node; waiting for b01, b03; b02: repairs its links")
        line(Event(EventKind.FINISHED, "b02", 0.0))
        assert screen.getvalue().endswith("queried 1 node; waiting for b01, b03")
        line.print_above("stopping: finishing the nodes in progress")
        assert screen.getvalue().endswith("\r\x1b[Kstopping: finishing the nodes in progress\n")
        line(finished("b01"))
    assert screen.getvalue().endswith("queried 2 nodes; waiting for b03\r\x1b[K")


def test_a_line_of_many_nodes_fits_into_the_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "30")
    with query_line() as line:
        for number in range(6):
            line(started(f"b{number:02}"))
        assert line.text() == "queried 0 nodes; waiting for b00, b01, b02, b03 and 2 more"
        assert screen.getvalue().split("\r\x1b[K")[-1] == "queried 0 nodes; waiting ..."


def test_without_a_terminal_only_steps_that_take_minutes_are_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with query_line() as line:
        line(started("b01"))
        line(Event(EventKind.STEP, "b02", 0.0, "repairs its links"))
        line(finished("b01"))
    assert capsys.readouterr().err == "b02: repairs its links\n"
