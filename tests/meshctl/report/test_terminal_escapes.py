"""No output of a device can control the operator's terminal."""

from __future__ import annotations

import ast
import io
import json
import sys
import time
import unicodedata
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from meshctl.cli.fleet_view import paint
from meshctl.cli.live_screen import page
from meshctl.cli.status import show_preflight
from meshctl.fleet import Event, EventKind, Outcome, Result
from meshctl.fleet.journal import Journal
from meshctl.model import Fleet
from meshctl.plan import FileChange, NodePlan, Plan, Verdict
from meshctl.plan.saved import SavedPlan, dump, load
from meshctl.report.plan_text import plan_lines
from meshctl.report.progress import JsonProgress, LiveProgress, PlainProgress
from meshctl.report.terminal_escapes import clean, clean_styled, json_safe, one_line
from meshctl.status import Check
from meshctl.status.rows import TableCell
from meshctl.status.table import table_lines
from meshctl.status.text import text
from meshctl.status.values import Alarm, Level
from tests.meshctl.status.fleets import HEALTHY, status_of, trio

# clear screen, clipboard (OSC 52), title, 8-bit CSI, a right-to-left override, another line, markup of rich
HOSTILE = "\x1b[2J\x1b]52;c;aGk=\x07\x1b]0;owned\x1b\\\x9b2J\u202egnp.exe\r\nb02: done [red]\x7f"
CLI = Path(__file__).resolve().parents[3] / "meshctl" / "cli"


def steering(shown: str, allowed: str = "\n\t") -> list[str]:
    """The characters of an output that a terminal would obey, or that reorder it."""
    kinds = ("Cc", "Cf", "Cs", "Zl", "Zp", "Cn")
    return [one for one in shown if one not in allowed and unicodedata.category(one) in kinds]


def event(kind: EventKind, words: str) -> Event:
    outcome = Outcome("b01", Result.FAILED, words, hint=words) if kind is EventKind.FINISHED else None
    return Event(kind, "b01", time.time(), words, outcome=outcome)


@given(st.text())
def test_cleaning_removes_escapes_keeps_the_width_and_is_idempotent(words: str) -> None:
    shown = clean(words)
    assert steering(shown) == []
    assert len(shown) == len(words)
    assert clean(shown) == shown
    assert steering(one_line(words), "\t") == []


@given(st.text(st.characters(categories=("L", "N", "P", "S"))))
def test_letters_of_any_script_are_kept(words: str) -> None:
    assert clean(words) == words


@given(st.text())
def test_json_keeps_its_value_and_contains_no_terminal_escapes(words: str) -> None:
    written = json_safe(json.dumps({words: words}, ensure_ascii=False))
    assert json.loads(written) == {words: words}
    assert steering(written) == []


def test_only_our_own_color_escapes_are_kept() -> None:
    shown = clean_styled(f"{paint('ok', 'ok')} \x1b[2J\x1b]0;t\x07")
    assert shown.startswith("\x1b[32mok\x1b[0m")
    assert steering(shown.replace("\x1b[32m", "").replace("\x1b[0m", "")) == []


def test_a_plan_for_a_hostile_device_contains_no_terminal_escapes() -> None:
    files = (FileChange("etc/config/system", "changed", f"--- a\n+++ b\n-option x '{HOSTILE}'\n"),)
    node = NodePlan("b01", Verdict.CHANGE, files=files, notes=(HOSTILE,))
    refused = NodePlan("b02", Verdict.REFUSED, reason=HOSTILE, hint=HOSTILE)
    plan = Plan(
        "lab", 0.0, ("b00",), {"b01": node, "b02": refused}, notes=(HOSTILE,), refusal=HOSTILE, refusal_hint=HOSTILE
    )
    assert [steering(line.text) for line in plan_lines(plan) if steering(line.text)] == []
    saved = dump(SavedPlan(plan, b"salt", HOSTILE))
    assert steering(saved) == []
    assert load(saved, "plan.json").plan == plan


def test_the_progress_of_a_hostile_device_has_no_escapes_and_forges_no_line() -> None:
    out, json_out, screen = io.StringIO(), io.StringIO(), io.StringIO()
    console = Console(file=screen, force_terminal=True, width=200, color_system=None)
    live = LiveProgress(console, 1)
    for shown in (PlainProgress(out), JsonProgress(json_out), live):
        with shown:
            for kind in EventKind:
                shown(event(kind, HOSTILE))
    assert steering(out.getvalue()) == []
    assert not [line for line in out.getvalue().splitlines() if line.startswith("b02: done")]
    assert steering(json_out.getvalue()) == []
    assert json.loads(json_out.getvalue().splitlines()[-1])["outcome"]["reason"] == HOSTILE
    for sequence in ("\x1b[2J", "\x1b]", "\x9b", "\x07", "\u202e"):
        assert sequence not in screen.getvalue()
    assert "[red]" in screen.getvalue(), "markup is text"


def test_the_status_of_hostile_devices_contains_no_terminal_escapes(tmp_path: Path) -> None:
    fleet: Fleet = trio(tmp_path)
    status = status_of(fleet, {name: HEALTHY[name] for name in ("base", "b01")})
    node = replace(status.nodes[0], version=HOSTILE, via=HOSTILE, alarms=(Alarm(Level.ERROR, "x", HOSTILE, HOSTILE),))
    status = replace(status, nodes=(node, *status.nodes[1:]), strangers=(HOSTILE,))
    for width in (None, 80):
        shown = text(status, width)
        assert steering(shown) == []
        assert not [line for line in shown.splitlines() if line.startswith("b02: done")]
    drawn = page(text(status, 100, paint).splitlines(), 50)
    for sequence in ("\x1b[2J", "\x1b]", "\x9b", "\x07", "\u202e"):
        assert sequence not in drawn
    assert steering("\n".join(table_lines([{"health": TableCell("ok"), "name": TableCell(HOSTILE)}]))) == []


def test_the_history_of_a_hostile_device_contains_no_terminal_escapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    from meshctl.cli.main import main

    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    with Journal(tmp_path / "meshctl" / "journal.sqlite") as journal:
        run = journal.begin("provision", fleet="lab", inventory="/x", nodes=("b01",))
        run.finish_node(Outcome("b01", Result.FAILED, HOSTILE))
        run.end("1 failed")
    for words in (["history", "1"], ["history", "--node", "b01"], ["history", "1", "--json"]):
        with pytest.raises(SystemExit) as ended:
            main(words)
        assert ended.value.code == 0
    shown = capfd.readouterr().out
    assert "gnp.exe" in shown
    assert steering(shown) == []


def test_colors_of_status_and_preflight_are_kept(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = (Check("base", True, "answers"), Check("links", False, HOSTILE), Check("robots", True, "", False))
    monkeypatch.setattr("meshctl.cli.status.paint_of", lambda: paint)
    # as on a terminal, where colors are not stripped
    monkeypatch.setattr("typer.echo", lambda text, **_: sys.stdout.write(text))
    show_preflight(checks, as_json=False)
    shown = capsys.readouterr().out
    assert "\x1b[32mgo   \x1b[0m" in shown
    assert "\N{SYMBOL FOR ESCAPE}[32m" not in shown
    assert steering(clean_styled(shown).replace("\x1b", "")) == []
    show_preflight(checks, as_json=True)
    assert json.loads(capsys.readouterr().out)["checks"][1]["reason"] == HOSTILE


def test_every_command_prints_through_the_sanitizing_output_module() -> None:
    """New output goes through `meshctl.cli.output`; pages and live lines clean what they draw themselves."""
    own_sequences = {"output.py", "live_screen.py"}
    found = []
    for file in sorted(CLI.glob("*.py")):
        if file.name in own_sequences:
            continue
        for call in (node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Call)):
            name = ast.unparse(call.func)
            if name in ("print", "typer.echo", "typer.secho", "click.echo", "sys.stdout.write", "sys.stderr.write"):
                found.append(f"{file.name}:{call.lineno}: {name}")
    assert found == []
