"""Packages of a simultaneous change: installed one node at a time, before any cell changes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.apply import executor
from meshctl.fleet import Outcome, Result
from meshctl.fleet.events import silent
from meshctl.plan import PackageStep, Stage, StageKind


def test_a_failed_installation_is_not_repeated_on_the_other_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The change is canceled on all. Seen on real OpenWrt: each node in turn left the mesh until its window ended."""
    asked = []

    def install(ctx: Any, *_rest: object) -> Outcome:
        asked.append(ctx.name)
        return Outcome(ctx.name, Result.ROLLED_BACK, "it hears 0 mesh neighbors")

    monkeypatch.setattr(executor, "install", install)
    monkeypatch.setattr(executor, "_connection", lambda _ctx: None)
    plan: Any = SimpleNamespace(packages=PackageStep(("iw",), ("iw.apk",)))
    contexts: Any = {name: SimpleNamespace(name=name, plan=plan) for name in ("b02", "b01", "base")}
    stage = Stage(StageKind.SWITCH, tuple(contexts), "", mesh="main")
    unused: Any = None
    ended = executor._simultaneous_stage(stage, contexts, unused, unused, silent)
    assert asked == ["b02"]
    assert {name: outcome.result for name, outcome in ended.items()} == {
        "b02": Result.ROLLED_BACK,
        "b01": Result.PENDING,
        "base": Result.PENDING,
    }
    assert ended["base"].reason == "the mesh change was canceled: packages could not be installed on b02"
