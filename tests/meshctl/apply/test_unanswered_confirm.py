"""A confirmation whose answer is lost: the node may have kept its change, so nothing else may be said of it."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import change_in_progress, mesh_commit
from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.commit_confirm import _uncertain
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.mesh_commit import _confirm_all, _MeshCommit
from meshctl.apply.participant import Participant
from meshctl.device import deadman
from meshctl.device.connection import Endpoint
from meshctl.device.deadman import Change
from meshctl.device.errors import NodeRefused
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Interrupt, Outcome, Result
from meshctl.model import Secret

HERE = Endpoint("10.42.0.101")
CONNECTION = cast("SshConnection", SimpleNamespace(endpoint=HERE, close=lambda: None))
LOST = Unreachable("b01: the connection broke")
BACK = NodeRefused("the window has expired", code="restored", exit_status=3)


def a_change(monkeypatch: pytest.MonkeyPatch, answers: list[NodeError | None]) -> ChangeInProgress:
    """A change of b01 whose confirmations are answered like this (None: confirmed), then never again."""

    def confirm(*_: object, **__: object) -> None:
        answer = answers.pop(0) if answers else LOST
        if answer is not None:
            raise answer

    monkeypatch.setattr(deadman, "confirm", confirm)
    connections = SimpleNamespace(open=lambda *_, **__: CONNECTION, release=lambda *_: None)
    run = SimpleNamespace(
        new_listener=lambda *_: None, connections=connections, interrupt=Interrupt(), owner="operator"
    )
    ctx = SimpleNamespace(name="b01", run=run, node=None, plan=SimpleNamespace(splits=("channel 1 -> 6",), meshes=()))
    change = ChangeInProgress(cast("NodeContext", ctx), Change("c1", {}, ""), Secret("nonce"), 4, HERE, (HERE,))
    change.started_s = 0.0
    return change


@pytest.mark.parametrize(("answer", "is_lost"), [(None, False), (BACK, False), (LOST, True)])
def test_only_an_answer_tells_what_became_of_a_confirmation(
    monkeypatch: pytest.MonkeyPatch, answer: NodeError | None, is_lost: bool
) -> None:
    change = a_change(monkeypatch, [answer])
    if is_lost:
        with pytest.raises(Unreachable):
            change_in_progress.confirm(change)
    else:
        assert change_in_progress.confirm(change) is (answer is None)
    assert change.is_confirm_unanswered is is_lost


def test_a_node_that_did_not_answer_its_confirmation_is_not_said_to_have_rolled_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    change = a_change(monkeypatch, [])
    change.last_error = "b01: no answer"
    assert "; if it is running, its timer has rolled it back" in _uncertain(change).reason
    change.is_confirm_unanswered = True
    why = "it did not answer its confirmation (b01: no answer): "
    why += "it keeps the change if that arrived; otherwise its timer rolls it back"
    assert (_uncertain(change).result, _uncertain(change).reason) == (Result.UNCERTAIN, why)


class TestMesh:
    """A node that changed its cell, was confirmed, and lost the link before it could say so."""

    @pytest.fixture
    def confirm_all(self, monkeypatch: pytest.MonkeyPatch) -> Callable[[list[NodeError | None]], Outcome]:
        now_s = 0.0

        class Backoff:
            """Each pause takes a second."""

            def __init__(self, limit_s: float, _: object) -> None:
                self.limit_s = limit_s

            @property
            def elapsed_s(self) -> float:
                return now_s

            @property
            def is_over(self) -> bool:
                return now_s >= self.limit_s

            def pause(self) -> None:
                nonlocal now_s
                now_s += 1.0

        monkeypatch.setattr(mesh_commit, "Backoff", Backoff)

        def run(answers: list[NodeError | None]) -> Outcome:
            change = a_change(monkeypatch, answers)
            member = Participant(change.ctx, change=change, is_proven=True)
            with ThreadPoolExecutor(1) as pool:
                context = cast("RunContext", SimpleNamespace(interrupt=Interrupt()))
                commit = _MeshCommit(context, [member], change.window_s, 1, (), is_together=False, pool=pool)
                return _confirm_all(commit)["b01"]

        return run

    def test_it_is_asked_again_after_its_window(self, confirm_all: Callable[[list[NodeError | None]], Outcome]) -> None:
        # the window leaves one second for confirmations
        assert confirm_all([LOST, LOST, LOST, LOST, None]) == Outcome("b01", Result.DONE)

    def test_it_is_left_behind_if_it_says_so(self, confirm_all: Callable[[list[NodeError | None]], Outcome]) -> None:
        outcome = confirm_all([LOST, LOST, LOST, BACK])
        assert (outcome.result, outcome.reason.partition(":")[0]) == (Result.UNCERTAIN, "left behind")

    def test_nothing_is_claimed_of_one_that_stays_away(
        self, confirm_all: Callable[[list[NodeError | None]], Outcome]
    ) -> None:
        outcome = confirm_all([])
        why = "it did not answer its confirmation (b01: the connection broke): "
        why += "it is in the new cell if that arrived; otherwise it rolls back to the old one"
        assert (outcome.result, outcome.reason, outcome.facts) == (Result.UNCERTAIN, why, {})
