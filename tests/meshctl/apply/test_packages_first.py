"""Packages of a simultaneous change: installed one node at a time, before any cell changes."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from meshctl.apply import executor
from meshctl.errors import Unreachable
from meshctl.fleet import Outcome, Result
from meshctl.fleet.events import silent
from meshctl.plan import PackageStep, Stage, StageKind


def _switched(names: tuple[str, ...], interrupt: object) -> dict[str, Outcome]:
    """A mesh change of these nodes, each with a package."""
    plan: Any = SimpleNamespace(packages=PackageStep(("iw",), ("iw.apk",)))
    run = SimpleNamespace(interrupt=interrupt)
    contexts: Any = {name: SimpleNamespace(name=name, plan=plan, run=run) for name in names}
    unused: Any = None
    return executor._simultaneous_stage(
        Stage(StageKind.SWITCH, tuple(contexts), "", mesh="main"), contexts, unused, unused, silent
    )


def test_an_interrupt_during_the_installations_cancels_the_change(monkeypatch: pytest.MonkeyPatch) -> None:
    interrupt = SimpleNamespace(stopping=False)

    def install(ctx: Any, *_rest: object) -> Outcome:
        interrupt.stopping = True
        return Outcome(ctx.name, Result.DONE)

    monkeypatch.setattr(executor, "install", install)
    monkeypatch.setattr(executor, "_connection", lambda _ctx: None)
    ended = _switched(("b02", "b01", "base"), interrupt)
    assert {name: (outcome.result, outcome.reason) for name, outcome in ended.items()} == {
        "b02": (Result.PENDING, "the mesh change was canceled: interrupted"),
        "b01": (Result.PENDING, "interrupted before its packages were installed"),
        "base": (Result.PENDING, "the mesh change was canceled: interrupted"),
    }


def test_a_failed_installation_is_not_repeated_on_the_other_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """The change is canceled on all. Seen on real OpenWrt: each node in turn left the mesh until its window ended."""
    asked = []

    def install(ctx: Any, *_rest: object) -> Outcome:
        asked.append(ctx.name)
        return Outcome(ctx.name, Result.ROLLED_BACK, "it hears 0 mesh neighbors")

    monkeypatch.setattr(executor, "install", install)
    monkeypatch.setattr(executor, "_connection", lambda _ctx: None)
    ended = _switched(("b02", "b01", "base"), SimpleNamespace(stopping=False))
    assert asked == ["b02"]
    assert {name: outcome.result for name, outcome in ended.items()} == {
        "b02": Result.ROLLED_BACK,
        "b01": Result.PENDING,
        "base": Result.PENDING,
    }
    assert ended["base"].reason == "the mesh change was canceled: packages could not be installed on b02"


def test_after_another_supplicant_the_nodes_are_connected_again_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen on real OpenWrt: the base's radio had restarted, no node behind it could be armed, and all was canceled."""
    events: list[str] = []
    attempts = iter([Unreachable("no route"), Unreachable("no route"), None, None])

    def connection(ctx: Any) -> None:
        error = next(attempts)
        if error is not None:
            raise error

    def commit(_run: object, given: Any, **_rest: object) -> dict[str, Outcome]:
        events.append("commit")
        return {ctx.name: Outcome(ctx.name, Result.DONE) for ctx in given}

    pool = SimpleNamespace(
        drop=lambda name: events.append(f"drop {name}"), release=lambda name, _made: events.append(f"connected {name}")
    )
    interrupt = SimpleNamespace(stopping=False, wait=lambda _s: events.append("wait"))
    fleet = SimpleNamespace(apply=SimpleNamespace(quorum=1.0, parallel=1))
    run: Any = SimpleNamespace(connections=pool, interrupt=interrupt, fleet=fleet)
    step = PackageStep(("wpad-openssl",), ("wpad-openssl.apk",), ("wpad-basic",))
    monkeypatch.setattr(executor, "_packages_first", lambda *_given: None)
    monkeypatch.setattr(executor, "_connection", connection)
    monkeypatch.setattr(executor, "commit_mesh", commit)
    plan: Any = SimpleNamespace(packages=step, reloads=("wireless",), entries=("base",))
    contexts: Any = {name: SimpleNamespace(name=name, plan=plan, run=run) for name in ("b01", "base")}
    executor._simultaneous_stage(Stage(StageKind.SWITCH, tuple(contexts), "", mesh="main"), contexts, plan, run, silent)
    assert events == ["drop b01", "wait", "wait", "connected b01", "drop base", "connected base", "commit"]
