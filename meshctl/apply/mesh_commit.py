"""Change many nodes simultaneously, all or nothing: arm, schedule, prove, then confirm or roll back.

`commit_mesh` arms every participant (`_arm`) and schedules the same moment on all, as the uptime of each node measured
just before (`_schedule`), so no clock has to be set. Then it looks for all of them (`_decide`), in the new cell if they
change it. When all have proven themselves they are confirmed; when the others have failed, and at the deadline, a
quorum of each mesh that includes the base is enough. Otherwise all are rolled back, nodes out of reach by their own
timers.

A node that leaves its cell and does not prove itself is left behind there. One that keeps its cell (`together`) rolls
back alone, and is reached as before.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

from meshctl.apply.change_in_progress import (
    ChangeInProgress,
    abort,
    arm,
    confirm,
    connect,
    new_change,
    start,
    unlock,
)
from meshctl.apply.commit_confirm import GRACE_AFTER_WINDOW_S, poll
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.first_boot import await_first_boot
from meshctl.apply.mesh_proof import prove, prove_until
from meshctl.apply.participant import (
    Participant,
    canceled_because,
    cause_of,
    entries_lost,
    lead_s,
    quorum_of,
    rolled_back_outcome,
    short_of_quorum,
    unconfirmed_outcome,
    unmet_of,
)
from meshctl.device.errors import NodeRefused
from meshctl.device.openwrt import measure_uptime
from meshctl.device.ssh import SshConnection
from meshctl.errors import NodeError
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff
from meshctl.wording import counted

# What a loaded node needs to stage and arm a change. The first waits, with its lock, for every further batch.
ARM_S = 60.0
# The share of the confirm window reserved for confirming.
CONFIRM_SHARE = 0.25


@dataclass(slots=True)
class _MeshCommit:
    """A mesh change in progress. `participants` are ordered farthest first, the entry nodes last."""

    run: RunContext
    participants: Sequence[Participant]
    window_s: int
    parallel: int
    entries: Sequence[str]
    is_together: bool
    pool: ThreadPoolExecutor = field(repr=False)

    @property
    def name(self) -> str:
        return "the simultaneous change" if self.is_together else "the mesh change"

    @property
    def turns(self) -> int:
        """How many batches of parallel commands reach all nodes."""
        return math.ceil(len(self.participants) / self.parallel)

    @property
    def longest_s(self) -> float:
        """How long after it is armed the change of a node has ended."""
        return self.turns * ARM_S + self.window_s + GRACE_AFTER_WINDOW_S

    @property
    def success(self) -> str:
        return "passed their checks" if self.is_together else "rejoined"

    def each(self, participants: Iterable[Participant], act: Callable[[Participant], None]) -> None:
        """Run `act` for all, `parallel` at a time, and wait; an unexpected exception is raised."""
        for future in [self.pool.submit(act, participant) for participant in participants]:
            future.result()


def commit_mesh(
    run_context: RunContext,
    contexts: Sequence[NodeContext],
    *,
    quorum: float,
    parallel: int,
    entries: Sequence[str],
    together: bool = False,
) -> dict[str, Outcome]:
    """Apply the file changes of these nodes simultaneously. Returns each node's outcome; raises nothing for a node."""
    participants = [Participant(ctx, together) for ctx in contexts]
    window_s = max(ctx.node.confirm_window_s for ctx in contexts)
    with ThreadPoolExecutor(max_workers=max(1, parallel), thread_name_prefix="switch") as pool:
        commit = _MeshCommit(run_context, participants, window_s, max(1, parallel), entries, together, pool)
        # before the first is armed, because its lock ends soon after its window would
        commit.each(participants, lambda participant: _await_first_boot(commit, participant))
        if not any(participant.failure for participant in participants):
            commit.each(participants, lambda participant: _arm(commit, participant))
        if any(participant.failure for participant in participants) or run_context.interrupt.stopping:
            return _cancel(commit, canceled_because(participants, "armed", commit.name))
        _schedule(commit)
        if not all(participant.is_scheduled for participant in participants):
            return _cancel(commit, canceled_because(participants, "scheduled", commit.name))
        needed = quorum_of(participants, quorum)
        quorum_text = ", ".join(
            f"{count} of mesh {mesh}" if len(needed) > 1 else f"{count}" for mesh, count in needed.items()
        )
        must = "pass their checks" if together else "rejoin"
        verb = "changes" if len(participants) == 1 else "change"
        run_context.note(f"{counted(len(participants), 'node')} {verb} simultaneously; {quorum_text} must {must}")
        try:
            return _decide(commit, needed)
        finally:
            for participant in participants:
                participant.await_look()
                if (unused := participant.take_proof()) is not None:
                    unused.close()


def _await_first_boot(commit: _MeshCommit, participant: Participant) -> None:
    ctx = participant.ctx
    if not ctx.before.is_first_boot:
        return
    try:
        with commit.run.connections.borrow(ctx.node) as connection:
            await_first_boot(ctx, connection)
    except NodeError as error:
        participant.failure = Outcome(ctx.name, Result.FAILED, str(error), hint=error.hint)


def _arm(commit: _MeshCommit, participant: Participant) -> None:
    ctx = participant.ctx
    try:
        with commit.run.connections.borrow(ctx.node) as connection:
            participant.change = new_change(ctx, connection.endpoint, window_s=commit.window_s)
            participant.change.held_s = commit.turns * ARM_S
            arm(participant.change, connection)
            if commit.is_together:
                _watch_unchanged(commit, participant.change, connection)
            else:
                # it may be called off before its radio restarts, and then keeps its entries of those that did restart
                listener = participant.change.listener
                listener.watch_own_entries(connection, for_s=commit.longest_s)
            participant.clock = measure_uptime(connection)
    except NodeError as error:
        participant.failure = Outcome(ctx.name, Result.FAILED, str(error), hint=error.hint)


def _watch_unchanged(commit: _MeshCommit, change: ChangeInProgress, connection: SshConnection) -> None:
    """Neighbors that keep their radios up keep their station entries of this node's radios as well."""
    if not change.radios:
        return
    change.listener.restarting(
        [other.name for other in commit.participants if other.change is not None and other.change.radios]
    )
    change.listener.armed(connection, for_s=commit.longest_s, is_alone=False)


def _schedule(commit: _MeshCommit) -> None:
    """Schedule the change on every node, in its own uptime."""
    moment = time.monotonic() + lead_s(commit.participants, commit.turns)

    def start_one(participant: Participant) -> None:
        if participant.change is None or participant.clock is None:
            return
        try:
            with commit.run.connections.borrow(participant.ctx.node) as connection:
                _start_at(commit, participant, connection, moment)
            participant.is_scheduled = True
        except NodeError as error:
            participant.failure = Outcome(participant.name, Result.FAILED, str(error), hint=error.hint)
            if not isinstance(error, NodeRefused):
                # only its answer may be lost
                participant.change.last_error = str(error)

    commit.each(commit.participants, start_one)
    if all(participant.is_scheduled for participant in commit.participants):
        for participant in commit.participants:
            commit.run.connections.drop(participant.name)
        commit.run.interrupt.wait(max(0.0, moment - time.monotonic()))
        for participant in commit.participants:
            if participant.change is not None:
                # a station entry from between the order and the moment is stale, too
                participant.change.listener.started()


def _start_at(commit: _MeshCommit, participant: Participant, connection: SshConnection, moment: float) -> None:
    """Start it at the moment, or immediately if that has passed: the others are changing, and would leave it behind."""
    assert participant.change is not None
    assert participant.clock is not None
    try:
        start(participant.change, connection, at_uptime_s=participant.clock.uptime_at(moment), due_s=moment)
    except NodeRefused as refusal:
        if refusal.code != "too-late" or any(each.failure for each in commit.participants):
            raise
        commit.run.note(
            "the start arrived after the moment at which all nodes change; it changes now", participant.name
        )
        start(participant.change, connection)


def _cancel(commit: _MeshCommit, reason: str) -> dict[str, Outcome]:
    """Cancel the change on every node before it starts."""

    def cancel_one(participant: Participant) -> None:
        change = participant.change
        if change is None:
            return
        change.is_abandoned = True
        try:
            with commit.run.connections.borrow(participant.ctx.node) as connection:
                abort(change, connection)
                unlock(change, connection)
        except NodeError as error:
            change.last_error = str(error)
        is_unknown = bool(change.last_error)
        if participant.is_scheduled or is_unknown:
            # it may have started before it was aborted
            outcome, failure = poll(change), participant.failure
            if not outcome.result.is_good and (failure is None or is_unknown):
                why = f"{reason if failure is None else failure.reason}; {outcome.reason}"
                participant.failure = replace(outcome, reason=why)

    commit.each(commit.participants, cancel_one)
    return {
        participant.name: participant.failure or Outcome(participant.name, Result.PENDING, reason)
        for participant in commit.participants
    }


def _decide(commit: _MeshCommit, needed: Mapping[str, int]) -> dict[str, Outcome]:
    """Observe the participants until each has proven itself or failed, or time is up; then decide, once."""
    backoff = Backoff(commit.window_s * (1 - CONFIRM_SHARE), commit.run.interrupt)
    commit.run.interrupt.wait(
        max(participant.change.first_look_s for participant in commit.participants if participant.change is not None)
    )
    prove_until(commit.participants, backoff, commit.pool)
    proven = [participant for participant in commit.participants if participant.is_proven]
    lost = [each for each in commit.participants if each.name in commit.entries and each not in proven]
    why = entries_lost(lost, commit.entries) if lost else short_of_quorum(proven, needed, commit.success)
    if not why:
        return _confirm_all(commit)
    if commit.run.interrupt.leaving:
        why = "interrupted before enough nodes passed their checks"
    unproven = [cause_of(each) or unmet_of(each) for each in commit.participants if not each.is_proven]
    commit.run.note(f"{why}; rolling back: {'; '.join(unproven)}")
    return _roll_back(commit, why)


def _confirm_all(commit: _MeshCommit) -> dict[str, Outcome]:
    """Confirm the proven participants, and late ones until the window ends; the others roll back. One that has not
    answered its confirmation may have kept the change: it is asked again until its rollback would have ended, too."""

    def confirm_one(participant: Participant) -> None:
        participant.await_look()
        if not participant.is_decided:
            prove(participant)
        if participant.change is None or not participant.is_proven:
            return
        try:
            participant.is_confirmed = confirm(participant.change)
        except NodeError as error:
            participant.change.last_error = str(error)

    window_s = commit.window_s * CONFIRM_SHARE
    backoff = Backoff(window_s + GRACE_AFTER_WINDOW_S, commit.run.interrupt)

    def unconfirmed() -> list[Participant]:
        return [p for p in commit.participants if p.awaits_confirm(is_window_over=backoff.elapsed_s > window_s)]

    while (left := unconfirmed()) and not backoff.is_over:
        commit.each(sorted(left, key=lambda participant: not participant.is_proven), confirm_one)
        if commit.run.interrupt.leaving or not unconfirmed():
            break
        backoff.pause()
    ended: dict[str, Outcome] = {}

    def end_one(participant: Participant) -> None:
        ended[participant.name] = _confirmed_outcome(participant)

    commit.each(commit.participants, end_one)
    return {participant.name: ended[participant.name] for participant in commit.participants}


def _confirmed_outcome(participant: Participant) -> Outcome:
    change = participant.change
    if participant.is_confirmed:
        if participant.is_together and change is not None:
            change.listener.ended(change.last)
        return Outcome(participant.name, Result.DONE)
    if not participant.leaves_cell and change is not None:
        # it is where it was, so its way back can be observed
        change.is_abandoned = True
        return poll(change)
    return unconfirmed_outcome(participant)


def _roll_back(commit: _MeshCommit, reason: str) -> dict[str, Outcome]:
    """Roll the reachable nodes back, then poll them all. Nodes that go back to another cell do so the farthest first,
    so that the path to the others lasts."""
    unmet = {
        participant.name: unmet_of(participant) for participant in commit.participants if not participant.is_proven
    }

    def abort_one(participant: Participant) -> None:
        if participant.change is None:
            return
        participant.change.is_abandoned = True
        connection = connect(participant.change)
        if connection is None:
            return
        try:
            abort(participant.change, connection)
        except NodeError as error:
            participant.change.last_error = str(error)
        finally:
            connection.close()

    if any(participant.leaves_cell for participant in commit.participants):
        for participant in commit.participants:
            abort_one(participant)
    else:
        commit.each(commit.participants, abort_one)
    ended: dict[str, Outcome] = {}

    def poll_one(participant: Participant) -> None:
        participant.await_look()
        if participant.change is not None:
            ended[participant.name] = poll(participant.change)

    commit.each(commit.participants, poll_one)
    return {
        participant.name: rolled_back_outcome(
            ended.get(participant.name),
            participant.name,
            f"{'all nodes were' if commit.is_together else 'the whole mesh was'} rolled back: {reason}",
            cause_of(participant) or unmet.get(participant.name, ""),
        )
        for participant in commit.participants
    }
