"""The looks for the participants of a simultaneous change."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Event
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import mesh_commit, mesh_proof
from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.next_action import Action
from meshctl.apply.participant import Participant, unmet_of
from meshctl.device.connection import Endpoint
from meshctl.fleet import Interrupt, Result
from meshctl.nodes.backoff import Backoff

# How long a look that hangs waits for what should happen meanwhile.
HANG_S = 20.0


def test_a_connection_that_was_opened_after_the_reload_is_kept_until_the_node_has_proven_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    there = Endpoint("10.42.0.101")
    change = SimpleNamespace(is_reloaded=False, last=None, last_error="", new=there)
    base = Participant(
        cast("NodeContext", SimpleNamespace(name="b01", plan=SimpleNamespace(splits=("main",)))),
        change=cast("ChangeInProgress", change),
    )
    opened: list[SimpleNamespace] = []

    def connect(_: object) -> SimpleNamespace:
        connection = SimpleNamespace(endpoint=there, is_open=True, number=len(opened))
        connection.close = lambda: setattr(connection, "is_open", False)
        opened.append(connection)
        return connection

    actions = [Action.WAIT, Action.WAIT, Action.WAIT, Action.CONFIRM]
    looks: list[tuple[int, bool]] = []

    def look(_: object, connection: SimpleNamespace, *, is_opened_after_reload: bool) -> Action:
        looks.append((connection.number, is_opened_after_reload))
        change.is_reloaded = True
        return actions[len(looks) - 1]

    monkeypatch.setattr(mesh_proof, "connect", connect)
    monkeypatch.setattr(mesh_proof, "observe_and_decide", look)
    for number in range(4):
        if number == 3:
            # such as by a relay that restarts
            opened[1].is_open = False
        mesh_proof.prove(base)
    assert looks == [(0, False), (1, True), (1, True), (2, True)]
    assert base.is_proven
    assert not any(connection.is_open for connection in opened)


def participant(name: str, calls: list[str]) -> Participant:
    ctx = SimpleNamespace(name=name, plan=SimpleNamespace(splits=("main",)))
    listener = SimpleNamespace(unreachable=lambda proven: calls.append(f"{name}: {sorted(proven)}"))
    change = SimpleNamespace(listener=listener, is_confirm_unanswered=False, unmet=())
    return Participant(cast("NodeContext", ctx), change=cast("ChangeInProgress", change))


def look_by(monkeypatch: pytest.MonkeyPatch, looks: dict[str, Callable[[Participant], None]]) -> None:
    def prove(each: Participant) -> None:
        looks[each.name](each)

    monkeypatch.setattr(mesh_proof, "prove", prove)
    monkeypatch.setattr(mesh_commit, "prove", prove)


def test_a_look_that_hangs_holds_up_no_other_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen on real OpenWrt: all waited 20 s, a fifth of the time until the decision, for one whose radio restarted."""
    calls: list[str] = []
    near, far = participant("b01", calls), participant("b02", calls)
    second_look = Event()
    seen: list[bool] = []

    def hangs(each: Participant) -> None:
        seen.append(second_look.wait(HANG_S))
        each.decide(Action.CONFIRM)

    def answers(each: Participant) -> None:
        each.is_unreachable = not calls
        if calls:
            each.decide(Action.CONFIRM)
            second_look.set()

    look_by(monkeypatch, {"b01": answers, "b02": hangs})
    with ThreadPoolExecutor(2) as pool:
        mesh_proof.prove_until([far, near], Backoff(2 * HANG_S, Interrupt()), pool)
    assert seen == [True]
    assert near.is_proven
    assert far.is_proven
    # the first look had no answer
    assert calls == ["b01: []"]


def test_the_decision_does_not_wait_for_a_look_that_hangs(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would come when the windows are about to end, and some nodes would be confirmed in time and others not."""
    near, far, queued = (participant(name, []) for name in ("b01", "b02", "b03"))
    decided = Event()
    seen: list[bool] = []
    look_by(
        monkeypatch,
        {
            "b01": lambda each: each.decide(Action.CONFIRM),
            "b02": lambda each: seen.append(decided.wait(HANG_S)),
            "b03": lambda each: seen.append(False),
        },
    )
    with ThreadPoolExecutor(1) as pool:
        mesh_proof.prove_until([near, far, queued], Backoff(0.5, Interrupt()), pool)
        assert (near.is_proven, far.is_decided) == (True, False)
        assert queued.look is None
        decided.set()
        far.await_look()
    assert seen == [True]


@pytest.mark.parametrize(
    ("is_unreachable", "last_error", "expected"),
    [
        (False, "", "b01: it was not observed"),
        (True, "", "b01: it does not answer"),
        (False, "silent for 20 s", "b01: it does not answer (silent for 20 s)"),
    ],
)
def test_a_node_whose_first_look_is_in_progress_is_not_said_to_be_away(
    is_unreachable: bool, last_error: str, expected: str
) -> None:
    """Seen on real OpenWrt, after the second Ctrl-C: the base was about to answer."""
    change = cast("ChangeInProgress", SimpleNamespace(unmet=(), last_error=last_error))
    ctx = cast("NodeContext", SimpleNamespace(name="b01"))
    assert unmet_of(Participant(ctx, change=change, is_unreachable=is_unreachable)) == expected


def test_a_node_whose_look_ends_after_the_decision_is_confirmed_after_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    near, late = participant("b01", []), participant("b02", [])
    near.decide(Action.CONFIRM)
    events: list[str] = []

    def end_look() -> None:
        events.append("awaited b02")
        late.decide(Action.CONFIRM)

    def confirm(change: object) -> bool:
        events.append(f"confirmed {'b01' if change is near.change else 'b02'}")
        return True

    # not a second look beside it
    look_by(monkeypatch, {"b02": lambda each: events.append("looked again")})
    monkeypatch.setattr(mesh_commit, "confirm", confirm)
    run = cast("RunContext", SimpleNamespace(interrupt=Interrupt()))
    late.look = cast("Future[None]", SimpleNamespace(result=end_look))
    with ThreadPoolExecutor(1) as pool:
        commit = mesh_commit._MeshCommit(run, [late, near], 120, 1, (), is_together=False, pool=pool)
        ended = mesh_commit._confirm_all(commit)
    assert {name: outcome.result for name, outcome in ended.items()} == {"b01": Result.DONE, "b02": Result.DONE}
    assert events == ["confirmed b01", "awaited b02", "confirmed b02"]
