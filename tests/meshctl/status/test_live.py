"""The live screen on a real terminal: it follows the window size, ends on Ctrl-C, and restores the screen."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from tests.meshctl.status.terminal import Terminal

ENTERED, LEFT = r"\x1b\[\?1049h", r"\x1b\[\?1049l"
# How a look goes, by the word the program gets; `look` counts the looks.
PROGRAM = """\
import sys, threading
from meshctl.cli.live_screen import live_screen
looks = 0
def look():
    global looks
    looks += 1
    if sys.argv[1] == "hangs" and looks > 1:
        threading.Event().wait()
    if sys.argv[1] == "fails" and looks > 1:
        raise RuntimeError("no such radio")
    return looks
def draw(seen, size):
    return [f"look {seen} in {size.columns} x {size.lines}", *(f"line {n}" for n in range(10))]
print("before")
print("last", live_screen(look, draw, 0.05, sys.stdout))
"""


def page(how: str, *, lines: int = 24, columns: int = 80, has_shell: bool = False) -> Terminal:
    environ = {key: value for key, value in os.environ.items() if key not in ("LINES", "COLUMNS")}
    environ["PYTHONPATH"] = str(Path(__file__).parents[3])
    return Terminal([sys.executable, "-c", PROGRAM, how], environ, lines=lines, columns=columns, has_shell=has_shell)


@pytest.mark.parametrize("how", ["goes on", "hangs"])
def test_a_page_follows_resizes_and_ctrl_c_restores_the_screen(how: str) -> None:
    with page(how, columns=100) as terminal:
        shown = terminal.shows(r"look \d+ in 100 x 24.*line 9", "a page")
        assert shown.startswith("before")
        for lines, columns in ((40, 90), (5, 33), (24, 72)):
            terminal.forget()
            terminal.resize(lines, columns)
            output = terminal.shows(rf"look \d+ in {columns} x {lines}.*(line 9|more lines)", "a page of the new size")
            assert ("more lines" in output) == (lines < 11)
        terminal.forget()
        terminal.press(b"\x03")
        terminal.shows(rf"{LEFT}.*last \d+", "the screen from before")
        assert terminal.exit_code() == 0


def test_a_burst_of_resizes_ends_with_a_page_of_the_final_size() -> None:
    with page("goes on") as terminal:
        terminal.shows("line 9", "a page")
        for columns in range(80, 140):
            terminal.resize(30, columns)
        terminal.shows("in 139 x 30", "the last size")
        terminal.press(b"\x03")
        assert terminal.exit_code() == 0


@pytest.mark.parametrize("has_shell", [True, False])
def test_ctrl_z_restores_the_screen_until_the_page_resumes(has_shell: bool) -> None:
    # without a shell in its session it is in an orphaned process group, which the kernel does not stop
    with page("goes on", has_shell=has_shell) as terminal:
        terminal.shows("line 9", "a page")
        terminal.forget()
        terminal.press(b"\x1a")
        if has_shell:
            terminal.shows(LEFT, "the screen from before")
            terminal.has_state("T")
            terminal.forget()
            terminal.signal(signal.SIGCONT)
            terminal.shows(f"{ENTERED}.*line 9", "the page again")
        else:
            terminal.shows(f"{LEFT}.*{ENTERED}.*line 9", "the page again")
        terminal.forget()
        terminal.press(b"\x03")
        terminal.shows(LEFT, "the screen from before")


def test_sigterm_restores_the_screen() -> None:
    with page("hangs") as terminal:
        terminal.shows("line 9", "a page")
        terminal.forget()
        terminal.signal(signal.SIGTERM)
        terminal.shows(LEFT, "the screen from before")
        assert terminal.exit_code() == 128 + signal.SIGTERM


def test_an_error_is_reported_after_the_screen_is_restored() -> None:
    with page("fails") as terminal:
        terminal.shows(f"{LEFT}.*no such radio", "the mistake")
        assert terminal.exit_code() == 1
