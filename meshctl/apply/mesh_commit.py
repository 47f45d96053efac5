"""Change a whole mesh simultaneously, all or nothing: arm, schedule, prove, then confirm or roll back.

`commit_mesh` arms every participant (`_arm`) and schedules the same moment on all, as the uptime of each node measured
just before (`_schedule`), so no clock has to be set. Then it looks for all of them in the new cell (`_decide`). When
all have proven themselves they are confirmed; at the deadline a quorum of each mesh that includes the base is enough.
Otherwise the reachable nodes are rolled back, the farthest first, and the others by their own timers.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from meshctl.apply.change_in_progress import (
    ChangeInProgress,
    abort,
    arm,
    confirm,
    connect,
    new_change,
    observe_and_decide,
    start,
    unlock,
)
from meshctl.apply.commit_confirm import poll
from meshctl.apply.context import NodeContext, RunContext
from meshctl.apply.next_action import Action
from meshctl.device.openwrt import UptimeSample, measure_uptime
from meshctl.errors import NodeError
from meshctl.fleet import Outcome, Result
from meshctl.nodes.backoff import Backoff

# The scheduled moment is this many round trips of the slowest node ahead, for each batch of parallel commands, and at
# least LEAD_S: the slowest board needs that to start a start-stop-daemon and two shells.
LEAD_ROUND_TRIPS = 6
LEAD_S = 2.0
# The share of the confirm window reserved for confirming.
CONFIRM_SHARE = 0.25
# Each of the others has its own reason in its own outcome.
MAX_NAMED = 3
# The fact in the outcome of a node left in the old cell: what differs between its cell and the mesh's.
LEFT_BEHIND = "left_behind"


@dataclass(slots=True)
class Participant:
    """One node of the mesh change. `failure` is why it cannot take part."""

    ctx: NodeContext
    change: ChangeInProgress | None = None
    clock: UptimeSample | None = None
    failure: Outcome | None = None
    is_scheduled: bool = False
    is_unreachable: bool = False
    is_proven: bool = False
    is_confirmed: bool = False

    @property
    def name(self) -> str:
        return self.ctx.name

    @property
    def meshes(self) -> tuple[str, ...]:
        """The meshes whose cell this node changes."""
        return self.ctx.plan.parted_from


@dataclass(slots=True)
class _MeshCommit:
    """A mesh change in progress. `participants` are ordered farthest first, the entry node last."""

    run: RunContext
    participants: Sequence[Participant]
    window_s: int
    parallel: int
    entry: str
    pool: ThreadPoolExecutor = field(repr=False)

    def each(self, participants: Iterable[Participant], act: Callable[[Participant], None]) -> None:
        """Run `act` for all, `parallel` at a time, and wait; an unexpected exception is raised."""
        for future in [self.pool.submit(act, participant) for participant in participants]:
            future.result()


def commit_mesh(
    run_context: RunContext, contexts: Sequence[NodeContext], *, quorum: float, parallel: int, entry: str
) -> dict[str, Outcome]:
    """Apply the file changes of these nodes simultaneously. Returns each node's outcome; raises nothing for a node."""
    participants = [Participant(ctx) for ctx in contexts]
    window_s = max(ctx.node.confirm_window_s for ctx in contexts)
    with ThreadPoolExecutor(max_workers=max(1, parallel), thread_name_prefix="switch") as pool:
        commit = _MeshCommit(run_context, participants, window_s, max(1, parallel), entry, pool)
        commit.each(participants, lambda participant: _arm(commit, participant))
        if any(participant.failure for participant in participants) or run_context.interrupt.stopping:
            return _cancel(commit, canceled_because(participants, "armed"))
        _schedule(commit)
        if not all(participant.is_scheduled for participant in participants):
            return _cancel(commit, canceled_because(participants, "scheduled"))
        needed = quorum_of(participants, quorum)
        quorum_text = ", ".join(
            f"{count} of mesh {mesh}" if len(needed) > 1 else f"{count}" for mesh, count in needed.items()
        )
        run_context.note(f"{len(participants)} nodes change simultaneously; {quorum_text} must rejoin")
        return _decide(commit, needed)


def canceled_because(participants: Iterable[Participant], step: str) -> str:
    """Why nobody changes: the participants that could not be armed or scheduled, each with its reason."""
    failed = [
        f"{participant.name} could not be {step}: {participant.failure.reason}"
        for participant in participants
        if participant.failure is not None
    ]
    if not failed:
        return "the mesh change was canceled: interrupted"
    more = f"; and {len(failed) - MAX_NAMED} more" if len(failed) > MAX_NAMED else ""
    return f"the mesh change was canceled: {'; '.join(failed[:MAX_NAMED])}{more}"


def quorum_of(participants: Iterable[Participant], quorum: float) -> dict[str, int]:
    """How many nodes of each changing mesh must rejoin it."""
    counts = Counter(mesh for participant in participants for mesh in participant.meshes)
    return {mesh: max(1, math.ceil(quorum * count)) for mesh, count in counts.items()}


def short_of_quorum(proven: Iterable[Participant], needed: Mapping[str, int]) -> str:
    """Which meshes are below their quorum; empty when none is."""
    there = Counter(mesh for participant in proven for mesh in participant.meshes)
    short = {mesh: count for mesh, count in needed.items() if there[mesh] < count}
    return "; ".join(f"{there[mesh]} of mesh {mesh} rejoined, {count} required" for mesh, count in short.items())


def _arm(commit: _MeshCommit, participant: Participant) -> None:
    ctx = participant.ctx
    try:
        with commit.run.connections.borrow(ctx.node) as connection:
            participant.change = new_change(ctx, connection.endpoint, window_s=commit.window_s)
            arm(participant.change, connection)
            participant.clock = measure_uptime(connection)
    except NodeError as error:
        participant.failure = Outcome(ctx.name, Result.FAILED, str(error), hint=error.hint)


def _schedule(commit: _MeshCommit) -> None:
    """Schedule the change on every node, in its own uptime."""
    slowest_s = max(
        (2 * participant.clock.error_s for participant in commit.participants if participant.clock is not None),
        default=0.0,
    )
    turns = math.ceil(len(commit.participants) / commit.parallel)
    moment = time.monotonic() + max(LEAD_S, LEAD_ROUND_TRIPS * slowest_s * turns)

    def start_one(participant: Participant) -> None:
        if participant.change is None or participant.clock is None:
            return
        try:
            with commit.run.connections.borrow(participant.ctx.node) as connection:
                start(participant.change, connection, at_uptime_s=participant.clock.uptime_at(moment))
            participant.is_scheduled = True
        except NodeError as error:
            participant.failure = Outcome(participant.name, Result.FAILED, str(error), hint=error.hint)

    commit.each(commit.participants, start_one)
    if all(participant.is_scheduled for participant in commit.participants):
        for participant in commit.participants:
            commit.run.connections.drop(participant.name)
        time.sleep(max(0.0, moment - time.monotonic()))


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
        if participant.is_scheduled or change.last_error:
            # it may have started before it was aborted
            outcome = poll(change)
            if not outcome.result.is_good:
                participant.failure = participant.failure or outcome

    commit.each(commit.participants, cancel_one)
    return {
        participant.name: participant.failure or Outcome(participant.name, Result.PENDING, reason)
        for participant in commit.participants
    }


def _decide(commit: _MeshCommit, needed: Mapping[str, int]) -> dict[str, Outcome]:
    """Observe the participants in the new cell until all have proven themselves or time is up; then decide, once."""
    backoff = Backoff(commit.window_s * (1 - CONFIRM_SHARE), commit.run.interrupt)
    commit.run.interrupt.wait(
        max(participant.change.settle_s for participant in commit.participants if participant.change is not None)
    )
    while True:
        commit.each([participant for participant in commit.participants if not participant.is_proven], _prove)
        proven = [participant for participant in commit.participants if participant.is_proven]
        if len(proven) == len(commit.participants) or backoff.is_over or commit.run.interrupt.leaving:
            break
        _notify_unreachable(commit, proven)
        backoff.pause()
    has_entry = (
        not commit.entry
        or any(m.name == commit.entry for m in proven)
        or all(m.name != commit.entry for m in commit.participants)
    )
    why = short_of_quorum(proven, needed) if has_entry else "the base did not come back"
    if not why:
        return _confirm_all(commit)
    unproven = [unmet_of(participant) for participant in commit.participants if not participant.is_proven]
    commit.run.note(f"{why}; rolling back: {'; '.join(unproven)}")
    return _roll_back(commit, why)


def unmet_of(participant: Participant) -> str:
    """`b01: it has no route to the base`: why a participant had not proven itself in its latest observation."""
    change = participant.change
    if change is None or participant.is_unreachable or not change.unmet:
        last_error = "" if change is None else change.last_error
        return f"{participant.name}: it does not answer{f' ({last_error})' if last_error else ''}"
    return f"{participant.name}: {', '.join(change.unmet)}"


def _notify_unreachable(commit: _MeshCommit, proven: Sequence[Participant]) -> None:
    """Where a cell keeps its channel and BSSID, a node that changed early still hears one that changes late, and may
    create a station entry of the radio before its restart."""
    names = {participant.name for participant in proven}

    def notify_one(participant: Participant) -> None:
        if participant.change is not None and participant.is_unreachable:
            participant.change.listener.unreachable(names)

    commit.each(commit.participants, notify_one)


def _prove(participant: Participant) -> None:
    change = participant.change
    connection = None if change is None else connect(change)
    participant.is_unreachable = connection is None
    if change is None or connection is None:
        return
    try:
        participant.is_proven = observe_and_decide(change, connection) is Action.CONFIRM
        if change.last is not None:
            participant.ctx.run.record(participant.name, change.last)
    except NodeError as error:
        change.last_error = str(error)
    finally:
        connection.close()


def _confirm_all(commit: _MeshCommit) -> dict[str, Outcome]:
    """Confirm the proven participants, and late ones until the window ends; the others are left behind."""

    def confirm_one(participant: Participant) -> None:
        if not participant.is_proven:
            _prove(participant)
        if participant.change is None or not participant.is_proven:
            return
        try:
            participant.is_confirmed = confirm(participant.change)
        except NodeError as error:
            participant.change.last_error = str(error)

    backoff = Backoff(commit.window_s * CONFIRM_SHARE, commit.run.interrupt)
    while not backoff.is_over:
        commit.each([participant for participant in commit.participants if not participant.is_confirmed], confirm_one)
        if all(participant.is_confirmed for participant in commit.participants) or commit.run.interrupt.leaving:
            break
        backoff.pause()
    return {participant.name: _confirmed_outcome(participant) for participant in commit.participants}


def _confirmed_outcome(participant: Participant) -> Outcome:
    if participant.is_confirmed:
        return Outcome(participant.name, Result.DONE)
    unmet = (
        "; ".join(participant.change.unmet)
        if participant.change is not None and participant.change.unmet
        else "it was not observed"
    )
    return Outcome(
        participant.name,
        Result.UNCERTAIN,
        f"left behind: the others are in the new cell, it rolls back to the old one ({unmet})",
        hint="connect it by cable and run `meshctl resume`, or change the mesh back to the old cell",
        facts={LEFT_BEHIND: ", ".join(participant.ctx.plan.splits)},
    )


def _roll_back(commit: _MeshCommit, why: str) -> dict[str, Outcome]:
    """Roll the reachable nodes back, the farthest first so that the path to the others lasts; then poll them all."""
    unmet = {
        participant.name: unmet_of(participant) for participant in commit.participants if not participant.is_proven
    }
    for participant in commit.participants:
        if participant.change is None:
            continue
        participant.change.is_abandoned = True
        connection = connect(participant.change)
        if connection is None:
            continue
        try:
            abort(participant.change, connection)
        except NodeError as error:
            participant.change.last_error = str(error)
        finally:
            connection.close()
    ended: dict[str, Outcome] = {}

    def poll_one(participant: Participant) -> None:
        if participant.change is not None:
            ended[participant.name] = poll(participant.change)

    commit.each(commit.participants, poll_one)
    return {
        participant.name: _rolled_back_outcome(
            ended.get(participant.name), participant.name, why, unmet.get(participant.name, "")
        )
        for participant in commit.participants
    }


def _rolled_back_outcome(outcome: Outcome | None, name: str, why: str, gap: str) -> Outcome:
    if outcome is None:
        return Outcome(name, Result.PENDING, why)
    if outcome.result is Result.ROLLED_BACK:
        return Outcome(
            name, Result.ROLLED_BACK, f"the whole mesh was rolled back: {'; '.join(filter(None, (why, gap)))}"
        )
    return outcome
