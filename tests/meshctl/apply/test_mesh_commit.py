"""Each mesh of a simultaneous change must reach its quorum, not only most of the nodes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from meshctl.apply import mesh_commit
from meshctl.apply import participant as participant_module
from meshctl.apply.change_in_progress import ChangeInProgress
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.mesh_commit import _MeshCommit, commit_mesh
from meshctl.apply.next_action import Action
from meshctl.apply.participant import (
    Participant,
    canceled_because,
    cause_of,
    entries_lost,
    lead_s,
    quorum_of,
    short_of_quorum,
    unconfirmed_outcome,
)
from meshctl.device.errors import NodeRefused
from meshctl.device.observation import ChangeStatus, Observation
from meshctl.device.openwrt import UptimeSample
from meshctl.errors import NodeError, Unreachable
from meshctl.fleet import Interrupt, Outcome, Result


def participant(*meshes: str) -> Participant:
    return Participant(cast("NodeContext", SimpleNamespace(plan=SimpleNamespace(parted_from=meshes))))


MAIN = [participant("main") for _ in range(4)]
BOTH = participant("main", "far")
FAR = [participant("far"), participant("far")]
EVERYBODY = (*MAIN, BOTH, *FAR)


def test_a_quorum_is_counted_in_each_mesh() -> None:
    assert quorum_of(EVERYBODY, 0.5) == {"main": 3, "far": 2}
    assert quorum_of(MAIN, 0.0) == {"main": 1}


def test_the_quorum_of_one_mesh_does_not_count_for_another() -> None:
    needed = quorum_of(EVERYBODY, 0.5)
    assert short_of_quorum((*MAIN, BOTH), needed) == "1 of mesh far rejoined, 2 required"
    assert short_of_quorum(FAR, needed) == "0 of mesh main rejoined, 3 required"
    assert short_of_quorum((*MAIN[:2], BOTH, *FAR[:1]), needed) == ""


def not_ready(name: str, reason: str) -> Participant:
    ctx = cast("NodeContext", SimpleNamespace(name=name))
    return Participant(ctx, failure=Outcome(name, Result.FAILED, reason) if reason else None)


def test_a_canceled_change_names_the_nodes_that_were_not_ready_and_why() -> None:
    full = "stage: needs 72 KiB of flash, 8 KiB are free"
    assert (
        canceled_because([not_ready("b01", ""), not_ready("b07", full)], "armed")
        == f"the mesh change was canceled: b07 could not be armed: {full}"
    )
    many = [not_ready(f"b{number:02}", "it does not answer") for number in range(5)]
    assert canceled_because(many, "scheduled").endswith("b02 could not be scheduled: it does not answer; and 2 more")
    assert canceled_because([not_ready("b01", "")], "armed") == "the mesh change was canceled: interrupted"


def looked_at(*actions: Action, leaves_cell: bool) -> Participant:
    ctx = cast("NodeContext", SimpleNamespace(plan=SimpleNamespace(splits=("main",) if leaves_cell else ())))
    looked = Participant(ctx)
    for action in actions:
        looked.decide(action)
    return looked


def test_a_node_in_the_new_cell_is_looked_at_again_after_a_failed_reload() -> None:
    first = looked_at(Action.ABORT, leaves_cell=True)
    assert not first.is_decided
    second = looked_at(Action.ABORT, Action.CONFIRM, leaves_cell=True)
    assert (second.is_proven, second.has_failed) == (True, False)


def test_a_node_that_keeps_its_cell_is_given_up_after_a_failed_reload() -> None:
    assert looked_at(Action.ABORT, leaves_cell=False).has_failed


def test_a_node_that_went_back_is_given_up_in_either_case() -> None:
    assert looked_at(Action.WENT_BACK, leaves_cell=True).has_failed
    assert looked_at(Action.WENT_BACK, leaves_cell=False).has_failed


def test_no_node_is_armed_while_another_one_is_in_its_first_boot(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its wait may be longer than the lock of a node that is armed already."""

    @contextmanager
    def borrow(_: object) -> Iterator[None]:
        yield None

    def never_ends(ctx: NodeContext, _: object) -> None:
        raise NodeError(f"{ctx.name}: its first boot has not ended")

    armed: list[object] = []
    monkeypatch.setattr(mesh_commit, "await_first_boot", never_ends)
    monkeypatch.setattr(mesh_commit, "arm", lambda *change: armed.append(change))
    run = cast("RunContext", SimpleNamespace(connections=SimpleNamespace(borrow=borrow), interrupt=Interrupt()))
    contexts = [
        cast(
            "NodeContext",
            SimpleNamespace(
                name=name,
                node=SimpleNamespace(confirm_window_s=60),
                before=Observation(0.0, 0.1, is_first_boot=name == "b02"),
            ),
        )
        for name in ("b01", "b02")
    ]
    ended = commit_mesh(run, contexts, quorum=1.0, parallel=2, entries=())
    assert armed == []
    assert (ended["b01"].result, ended["b02"].result) == (Result.PENDING, Result.FAILED)
    assert "b02 could not be armed: b02: its first boot has not ended" in ended["b01"].reason


def test_a_node_that_is_armed_to_change_its_cell_watches_its_station_entries(monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def borrow(_: object) -> Iterator[SimpleNamespace]:
        yield SimpleNamespace(endpoint=None)

    watching: list[float] = []
    listener = SimpleNamespace(watch_own_entries=lambda _, for_s: watching.append(for_s))
    monkeypatch.setattr(mesh_commit, "new_change", lambda *ctx, **window: SimpleNamespace(listener=listener))
    held_s: list[float] = []
    monkeypatch.setattr(mesh_commit, "arm", lambda change, _: held_s.append(change.held_s))
    monkeypatch.setattr(mesh_commit, "measure_uptime", lambda _: None)
    run = cast("RunContext", SimpleNamespace(connections=SimpleNamespace(borrow=borrow)))
    members = [Participant(cast("NodeContext", SimpleNamespace(node=None, name=f"b{number}"))) for number in range(9)]
    with ThreadPoolExecutor(1) as pool:
        mesh_commit._arm(mesh_commit._MeshCommit(run, members, 60, 2, (), is_together=False, pool=pool), members[0])
    assert members[0].failure is None
    # five batches of two: its lock and its watch last until the last one is armed, too
    assert held_s == [5 * mesh_commit.ARM_S]
    assert watching[0] >= 5 * mesh_commit.ARM_S + 60


def test_a_node_that_was_scheduled_names_the_one_for_which_it_is_called_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen on real OpenWrt: b03's power was cut, and the others said no more than that they had been aborted."""

    @contextmanager
    def borrow(_: object) -> Iterator[None]:
        yield None

    def scheduled(name: str) -> Participant:
        ctx = cast("NodeContext", SimpleNamespace(name=name, node=None))
        change = cast("ChangeInProgress", SimpleNamespace(is_abandoned=False, last_error=""))
        return Participant(ctx, change=change, is_scheduled=True)

    monkeypatch.setattr(mesh_commit, "abort", lambda *change: None)
    monkeypatch.setattr(mesh_commit, "unlock", lambda *change: None)
    monkeypatch.setattr(mesh_commit, "poll", lambda change: Outcome("b01", Result.ROLLED_BACK, "it was aborted"))
    lost = Outcome("b03", Result.FAILED, "the connection broke")
    participants = [scheduled("b01"), replace(scheduled("b03"), failure=lost)]
    run = cast("RunContext", SimpleNamespace(connections=SimpleNamespace(borrow=borrow)))
    with ThreadPoolExecutor(1) as pool:
        commit = mesh_commit._MeshCommit(run, participants, 60, 1, (), is_together=False, pool=pool)
        ended = mesh_commit._cancel(commit, canceled_because(participants, "scheduled"))
    why = "the mesh change was canceled: b03 could not be scheduled: the connection broke; it was aborted"
    assert ended == {"b01": Outcome("b01", Result.ROLLED_BACK, why), "b03": lost}


@pytest.mark.parametrize(
    ("cause", "expected"),
    [
        # the order may have arrived: what the node itself says counts
        (
            Unreachable("the connection broke"),
            (Result.ROLLED_BACK, "the connection broke; it was not confirmed in time"),
        ),
        (NodeRefused("moved on", code="moved-on", exit_status=3), (Result.FAILED, "moved on")),
    ],
)
def test_a_node_whose_answer_to_the_start_was_lost_may_have_changed(
    monkeypatch: pytest.MonkeyPatch, cause: NodeError, expected: tuple[Result, str]
) -> None:
    """Seen on real OpenWrt: b02's power cut took b03's answer along, and b03, which its timer restored, "failed"."""

    @contextmanager
    def borrow(_: object) -> Iterator[None]:
        yield None

    def lost(*_: object, **__: object) -> None:
        raise cause

    monkeypatch.setattr(mesh_commit, "start", lost)
    monkeypatch.setattr(mesh_commit, "abort", lambda *change: None)
    monkeypatch.setattr(mesh_commit, "unlock", lambda *change: None)
    back = Outcome("b03", Result.ROLLED_BACK, "it was not confirmed in time")
    monkeypatch.setattr(mesh_commit, "poll", lambda change: back)
    change = cast("ChangeInProgress", SimpleNamespace(is_abandoned=False, last_error="", armed_in_s=0.0))
    clock = cast("UptimeSample", SimpleNamespace(error_s=0.1, uptime_at=lambda moment: moment))
    ctx = cast("NodeContext", SimpleNamespace(name="b03", node=None))
    run = cast("RunContext", SimpleNamespace(connections=SimpleNamespace(borrow=borrow)))
    with ThreadPoolExecutor(1) as pool:
        participants = [Participant(ctx, change=change, clock=clock)]
        commit = mesh_commit._MeshCommit(run, participants, 60, 1, (), is_together=False, pool=pool)
        mesh_commit._schedule(commit)
        ended = mesh_commit._cancel(commit, canceled_because(participants, "scheduled"))
    assert (ended["b03"].result, ended["b03"].reason) == expected


class TestMoment:
    """Seen on a busy host: the base's start arrived after the moment, so the others changed their cell without it."""

    @pytest.fixture(autouse=True)
    def restarting_radios(self) -> None:
        # the nodes whose radios may restart from now on
        self.restarting: list[str] = []

    def commit(self, participants: Sequence[Participant], notes: list[str], pool: ThreadPoolExecutor) -> _MeshCommit:
        connections = SimpleNamespace(borrow=lambda _: nullcontext(), drop=lambda _: None)
        run = SimpleNamespace(
            connections=connections,
            note=lambda text, node: notes.append(f"{node}: {text}"),
            interrupt=Interrupt(),
        )
        return _MeshCommit(cast("RunContext", run), participants, 60, 1, (), is_together=False, pool=pool)

    def member(self, name: str, *, armed_in_s: float = 0.0) -> Participant:
        listener = SimpleNamespace(started=lambda: self.restarting.append(name))
        fields = {"name": name, "armed_in_s": armed_in_s, "last_error": "", "listener": listener}
        change = cast("ChangeInProgress", SimpleNamespace(**fields))
        clock = cast("UptimeSample", SimpleNamespace(error_s=0.01, uptime_at=lambda moment: 100.0))
        ctx = cast("NodeContext", SimpleNamespace(name=name, node=None))
        return Participant(ctx, change=change, clock=clock)

    def schedule(
        self, monkeypatch: pytest.MonkeyPatch, refusals: dict[str, NodeError]
    ) -> tuple[list[tuple[str, float | None]], list[str], list[Participant]]:
        """Schedule b02, b01 and the base, of which some refuse a start at a moment; the starts, notes, participants."""
        starts: list[tuple[str, float | None]] = []
        notes: list[str] = []

        def start(
            change: SimpleNamespace, _: object, *, at_uptime_s: float | None = None, due_s: float | None = None
        ) -> None:
            assert (due_s is None) == (at_uptime_s is None)
            starts.append((change.name, at_uptime_s))
            if at_uptime_s is not None and change.name in refusals:
                raise refusals[change.name]

        monkeypatch.setattr(mesh_commit, "start", start)
        monkeypatch.setattr(participant_module, "LEAD_S", 0.0)
        participants = [self.member(name) for name in ("b02", "b01", "base")]
        with ThreadPoolExecutor(1) as pool:
            mesh_commit._schedule(self.commit(participants, notes, pool))
        return starts, notes, participants

    def test_a_node_whose_start_arrives_too_late_changes_immediately(self, monkeypatch: pytest.MonkeyPatch) -> None:
        late = NodeRefused("uptime 100 is 40 hundredths of a second ago", code="too-late", exit_status=3)
        starts, notes, participants = self.schedule(monkeypatch, {"base": late})
        assert starts == [("b02", 100.0), ("b01", 100.0), ("base", 100.0), ("base", None)]
        assert all(each.is_scheduled and each.failure is None for each in participants)
        assert notes == ["base: the start arrived after the moment at which all nodes change; it changes now"]
        # entries that a neighbor made between the order and the moment are stale, too
        assert self.restarting == ["b02", "b01", "base"]

    def test_a_change_that_is_canceled_starts_on_no_further_node(self, monkeypatch: pytest.MonkeyPatch) -> None:
        refusals: dict[str, NodeError] = {
            "b01": Unreachable("the connection broke"),
            "base": NodeRefused("40 hundredths of a second ago", code="too-late", exit_status=3),
        }
        starts, _, participants = self.schedule(monkeypatch, refusals)
        assert starts == [("b02", 100.0), ("b01", 100.0), ("base", 100.0)]
        assert [each.is_scheduled for each in participants] == [True, False, False]
        assert self.restarting == []

    def test_the_moment_leaves_the_slowest_node_time_to_start(self) -> None:
        participants = [self.member("b01", armed_in_s=0.1), self.member("b02", armed_in_s=4.0)]
        with ThreadPoolExecutor(1) as pool:
            one_after_the_other = self.commit(participants, [], pool)
            assert one_after_the_other.turns == 2
            assert replace(one_after_the_other, parallel=2).turns == 1
        assert lead_s(participants, 2) == 24.0
        assert lead_s(participants, 1) == 12.0
        assert lead_s(participants[:1], 1) == 2.0


def test_an_entry_node_that_answers_but_fails_its_checks_is_not_said_to_be_away() -> None:
    """Seen on real OpenWrt: the base answered, and heard no neighbor."""
    heard, away = (
        Participant(cast("NodeContext", SimpleNamespace(name=name)), is_unreachable=name == "b02")
        for name in ("b01", "b02")
    )
    assert entries_lost([heard], ["b01"]) == "the base did not pass its checks"
    assert entries_lost([away], ["b02"]) == "the base did not come back"
    assert entries_lost([heard], ["b01", "b02"]) == "b01 did not pass its checks"
    assert entries_lost([heard, away], ["b01", "b02"]) == "b01, b02 did not come back"


@pytest.mark.parametrize(
    ("change_id", "last_reason", "expected"),
    [
        ("c1", "boot", "b01: its power was cut, or it rebooted, before it was confirmed"),
        ("c1", "abort", "b01: it does not answer (no route to host)"),
        ("c1", "timeout", "b01: it does not answer (no route to host)"),
        # an earlier change's end
        ("c2", "boot", "b01: it does not answer (no route to host)"),
    ],
)
def test_a_node_of_a_mesh_that_was_rolled_back_names_its_own_cause(
    monkeypatch: pytest.MonkeyPatch, change_id: str, last_reason: str, expected: str
) -> None:
    """Seen on real OpenWrt: b01's power was cut in a switch of the channel, and it said only that it did not answer."""
    status = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason=last_reason)
    change = SimpleNamespace(id=change_id, is_abandoned=False, unmet=(), last_error="no route to host", status=status)
    monkeypatch.setattr(mesh_commit, "connect", lambda change: None)
    monkeypatch.setattr(mesh_commit, "poll", lambda change: Outcome("b01", Result.ROLLED_BACK, "its power was cut"))
    ctx = cast("NodeContext", SimpleNamespace(name="b01", plan=SimpleNamespace(splits=("main",))))
    participants = [Participant(ctx, change=cast("ChangeInProgress", change), is_unreachable=True)]
    with ThreadPoolExecutor(1) as pool:
        run = cast("RunContext", SimpleNamespace())
        commit = mesh_commit._MeshCommit(run, participants, 60, 1, (), is_together=False, pool=pool)
        ended = mesh_commit._roll_back(commit, "the base did not come back")
    why = f"the whole mesh was rolled back: the base did not come back; {expected}"
    assert ended == {"b01": Outcome("b01", Result.ROLLED_BACK, why)}


def test_an_entry_node_that_a_power_cut_has_rolled_back_is_not_said_to_have_failed_its_checks() -> None:
    """Seen on real OpenWrt: the base's power was cut as the switch began, and it answered again before the decision."""
    status = ChangeStatus("idle", last_id="c1", last_outcome="restored", last_reason="boot")
    change = cast("ChangeInProgress", SimpleNamespace(id="c1", status=status, unmet=(), last_error="refused"))
    base = Participant(cast("NodeContext", SimpleNamespace(name="base")), change=change, has_failed=True)
    assert entries_lost([base], ["base"]) == "the base rolled back"
    assert cause_of(base) == "base: its power was cut, or it rebooted, before it was confirmed"


def test_the_way_back_of_a_node_that_was_left_behind_names_the_option_it_needs() -> None:
    """Seen on real OpenWrt: the change back was refused, because it "would leave behind" the node in that very cell."""
    change = cast("ChangeInProgress", SimpleNamespace(is_confirm_unanswered=False, unmet=()))
    ctx = cast("NodeContext", SimpleNamespace(name="b03", plan=SimpleNamespace(splits=("radio0: channel 6 -> 11",))))
    left = unconfirmed_outcome(Participant(ctx, change=change))
    assert left.result is Result.UNCERTAIN
    assert left.hint.endswith("change the mesh back to the old cell with `--leave-behind b03`")
