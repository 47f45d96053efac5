"""Prompts and hints: no colors with NO_COLOR, and the hint that fits."""

from __future__ import annotations

import io
import re
import sys

import pytest

from meshctl.cli.main import main
from meshctl.cli.output import console
from meshctl.cli.plan import bench_advice
from meshctl.cli.plan_execution import bench_retry
from meshctl.device.framing import command_line
from meshctl.plan import NodePlan, Plan, Verdict


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


STYLES = re.compile(r"\x1b\[[0-9;]*m")


@pytest.mark.parametrize("words", [["--help"], ["plan", "--help"], ["robots", "deploy", "--help"], ["plan", "--nope"]])
def test_no_color_leaves_out_colors_and_bold_everywhere(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    def shown() -> str:
        out, err = Terminal(), Terminal()
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(sys, "stderr", err)
        with pytest.raises(SystemExit):
            main(words)
        return out.getvalue() + err.getvalue()

    monkeypatch.setenv("TERM", "xterm-256color")
    monkeypatch.setenv("NO_COLOR", "1")
    plain = shown()
    assert plain
    assert not STYLES.search(plain)


def test_no_color_leaves_plans_and_live_lines_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm-256color")
    for value, is_styled in (("", True), ("1", False)):
        out = Terminal()
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setenv("NO_COLOR", value)
        console().print("words", style="bold red")
        assert bool(STYLES.search(out.getvalue())) is is_styled


@pytest.mark.parametrize(
    ("command", "sent"),
    [(["ps | grep x"], "ps | grep x"), (["echo", "a  b", "$HOME"], "echo 'a  b' '$HOME'"), (["uptime"], "uptime")],
)
def test_a_single_argument_is_passed_to_the_shell_and_several_are_quoted(command: list[str], sent: str) -> None:
    assert command_line(command) == sent


def test_a_resumed_bootstrap_advises_connecting_unreachable_nodes_on_the_bench() -> None:
    nodes = {"b01": NodePlan("b01", Verdict.AWAY, reason="no answer"), "b02": NodePlan("b02", Verdict.SAME)}
    plan = Plan("f", 0.0, ("base",), nodes)
    assert bench_advice(7, "bootstrap", plan) == (
        "run 7 was a bootstrap: b01 may still have factory defaults",
        "hint: connect such a device on the bench and run `meshctl bootstrap` again",
    )
    same = Plan("f", 0.0, ("base",), {"b02": nodes["b02"]})
    assert bench_advice(7, "replace", same) == (
        "hint: run the same `meshctl replace b02 NEW` again to record it in the inventory",
    )
    assert bench_advice(7, "provision", plan) == ()
    assert bench_advice(7, "bootstrap", same) == ()


def test_a_resumed_bootstrap_without_any_reachable_node_advises_bootstrap_and_not_another_resume() -> None:
    away = {name: NodePlan(name, Verdict.AWAY, reason="no answer") for name in ("b01", "b02")}
    plan = Plan("f", 0.0, ("base",), away)
    assert bench_retry("bootstrap", plan) == "run `meshctl bootstrap b01 b02`"
    assert bench_retry("provision", plan) == ""
    some = Plan("f", 0.0, ("base",), {**away, "b03": NodePlan("b03", Verdict.CHANGE)})
    assert bench_retry("bootstrap", some) == ""
